# SPDX-License-Identifier: Apache-2.0
"""Files that appear whole, interruptions, and worker processes."""
