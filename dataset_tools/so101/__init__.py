# SPDX-License-Identifier: Apache-2.0
"""Demonstrations of the SO-101 arm."""
