# SPDX-License-Identifier: Apache-2.0
"""What every policy guided by a potential field has in common."""
