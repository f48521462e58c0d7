# SPDX-License-Identifier: Apache-2.0
"""The commands. Each parses its options, calls one function and prints the result in one line."""
