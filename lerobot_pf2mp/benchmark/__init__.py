# SPDX-License-Identifier: Apache-2.0
"""Compares policies on the same episodes."""
