# SPDX-License-Identifier: Apache-2.0
"""Kernel density estimates: kernels, how wide they are, and their sums."""
