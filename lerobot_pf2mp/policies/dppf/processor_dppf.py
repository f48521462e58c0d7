# SPDX-License-Identifier: Apache-2.0
"""The processors of DPPF, under the name by which LeRobot looks for them."""

from lerobot_pf2mp.policies.guided.processor_guided import (
    make_guided_pre_post_processors as make_dppf_pre_post_processors,
)

__all__ = ["make_dppf_pre_post_processors"]
