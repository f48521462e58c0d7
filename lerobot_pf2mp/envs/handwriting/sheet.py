# SPDX-License-Identifier: Apache-2.0
"""The sheet of paper in front of the arm, and the default size of a letter and its regions."""

# The sheet lies flat at the height of the robot's base. x points away from the base, y to its left.
SHEET_CENTRE = (0.50, 0.0)  # [m]
SHEET_SIDE = 0.32  # [m]; the upright pen reaches all of it

LETTER_HEIGHT = 0.18  # [m]
REGION_GAP = 0.008  # distance between a letter and its regions [m]
N_REGIONS = 2
HANDWRITING_FPS = 10  # [Hz]
