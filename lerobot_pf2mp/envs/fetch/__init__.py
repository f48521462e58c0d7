# SPDX-License-Identifier: Apache-2.0
"""The Fetch environments with a wall."""
