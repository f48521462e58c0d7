# SPDX-License-Identifier: Apache-2.0
"""Obstacles that are known at run time, from options or observations, in the guidance and the check of plans."""
