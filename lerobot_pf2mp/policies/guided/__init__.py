# SPDX-License-Identifier: Apache-2.0
"""Code shared by all policies that are guided by a potential field."""
