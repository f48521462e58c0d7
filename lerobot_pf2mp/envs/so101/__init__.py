# SPDX-License-Identifier: Apache-2.0
"""An SO-101 arm that carries a cube over a wall, in the simulation of so101-nexus."""
