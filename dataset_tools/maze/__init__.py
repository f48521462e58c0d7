# SPDX-License-Identifier: Apache-2.0
"""Demonstrations in mazes."""
