# SPDX-License-Identifier: Apache-2.0
"""Training: pf2mp-train, datasets in memory, and data shared by the processes of a run."""
