# SPDX-License-Identifier: Apache-2.0
"""The sheet of paper in front of the arm, and the default size of a letter and its regions."""

# The sheet lies flat on the table, at z = 0. x points from the arm to the sheet, y to the left. The base of the Panda is the
# origin; other arms stand where they reach the sheet.
SHEET_CENTRE = (0.50, 0.0)  # [m]
SHEET_SIDE = 0.32  # [m]; an upright pen reaches all of it with every arm

LETTER_HEIGHT = 0.18  # [m]
REGION_GAP = 0.008  # distance between a letter and its regions [m]
N_REGIONS = 2
HANDWRITING_FPS = 10  # [Hz]
