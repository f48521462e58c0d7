# SPDX-License-Identifier: Apache-2.0
"""The commands: each parses its options, calls one function and says in one line what came out."""
