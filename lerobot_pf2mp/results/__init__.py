# SPDX-License-Identifier: Apache-2.0
"""Results of a benchmark: rows, what is counted from them, and tables."""
