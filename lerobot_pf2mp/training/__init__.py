# SPDX-License-Identifier: Apache-2.0
"""Training: pf2mp-train, data held in memory, and what all processes of a run share."""
