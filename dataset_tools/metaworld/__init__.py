# SPDX-License-Identifier: Apache-2.0
"""Demonstrations of Meta-World's shipped experts."""
