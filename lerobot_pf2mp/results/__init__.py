# SPDX-License-Identifier: Apache-2.0
"""Results of a benchmark: rows, counts and tables."""
