# SPDX-License-Identifier: Apache-2.0
"""Episodes, and how they become a LeRobotDataset."""
