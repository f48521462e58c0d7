# SPDX-License-Identifier: Apache-2.0
"""Meta-World's tasks with a wall; they need the extra ``metaworld``."""
