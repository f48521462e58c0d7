# SPDX-License-Identifier: Apache-2.0
"""Tools that turn demonstrations into LeRobotDatasets."""
