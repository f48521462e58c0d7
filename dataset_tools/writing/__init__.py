# SPDX-License-Identifier: Apache-2.0
"""Episodes, and the writers that turn them into a LeRobotDataset."""
