# SPDX-License-Identifier: Apache-2.0
"""Atomic files, interruptions, and worker processes."""
