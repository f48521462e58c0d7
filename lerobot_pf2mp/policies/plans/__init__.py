# SPDX-License-Identifier: Apache-2.0
"""Plans, chunks of actions, are checked before they are executed."""
