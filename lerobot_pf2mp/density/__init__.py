# SPDX-License-Identifier: Apache-2.0
"""Kernel density estimates: Gaussian kernels, their bandwidth and their sums."""
