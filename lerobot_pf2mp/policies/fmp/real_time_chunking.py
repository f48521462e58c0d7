# SPDX-License-Identifier: Apache-2.0
"""Real-time chunking (Black et al., 2025, arXiv:2506.07339): a new chunk goes on from the one that is being executed.

The method is LeRobot's, which counts time from 1 (noise) to 0 (data). Time is reversed here and nowhere else.
"""

from __future__ import annotations

from lerobot.policies.rtc.modeling_rtc import RTCProcessor
from torch import Tensor

from lerobot_pf2mp.flow_matching import Steer


def continuing(
    processor: RTCProcessor, left_over: Tensor, inference_delay: int, execution_horizon: int | None = None
) -> Steer:
    """What steers the flow to chunks that begin with what is left of the last one.

    Args:
        processor: LeRobot's, with its weights and schedule.
        left_over: ``([B,] T_left, A)`` actions of the last chunk that have not been executed [normalised].
        inference_delay: Steps that will be executed before the new chunk is there; these stay as they are.
        execution_horizon: Steps up to which the new chunk is drawn to the old one; None for the processor's.

    Returns:
        Maps ``(B, T, A)`` points, ``(B,)`` times, 0 noise and 1 data and all the same, and velocities to velocities.
    """

    def steer(x_t: Tensor, t: Tensor, velocity: Tensor) -> Tensor:
        backward = processor.denoise_step(
            x_t=x_t,
            prev_chunk_left_over=left_over,
            inference_delay=inference_delay,
            time=float(1 - t[0]),
            original_denoise_step_partial=lambda _: -velocity,
            execution_horizon=execution_horizon,
        )
        return -backward

    return steer
