# SPDX-License-Identifier: Apache-2.0
"""The processors of DPPF, under the name that LeRobot looks up."""

from lerobot_pf2mp.policies.guided.processor_guided import (
    make_guided_pre_post_processors as make_dppf_pre_post_processors,
)

__all__ = ["make_dppf_pre_post_processors"]
