# SPDX-License-Identifier: Apache-2.0
"""The policies, each in LeRobot's three files."""
