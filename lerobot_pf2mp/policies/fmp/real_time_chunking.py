# SPDX-License-Identifier: Apache-2.0
"""Real-time chunking (Black et al., 2025, arXiv:2506.07339): a new chunk continues the one that is being executed.

The method is LeRobot's. LeRobot counts time from 1 (noise) to 0 (data). Only this file converts between the directions.
"""

from __future__ import annotations

from lerobot.policies.rtc.modeling_rtc import RTCProcessor
from torch import Tensor

from lerobot_pf2mp.flow_matching import Steer


def continuing(
    processor: RTCProcessor, left_over: Tensor, inference_delay: int, execution_horizon: int | None = None
) -> Steer:
    """A function that steers the flow towards chunks that begin with the remaining actions of the last chunk.

    Args:
        processor: LeRobot's RTC processor, with its weights and schedule.
        left_over: ``([B,] T_left, A)`` actions of the last chunk that have not been executed [normalised].
        inference_delay: Steps that will be executed before the new chunk is available. Their actions stay unchanged.
        execution_horizon: Number of steps over which the new chunk is pulled towards the old one; None for the value of
            the processor.

    Returns:
        A function that maps ``(B, T, A)`` points, ``(B,)`` times and ``(B, T, A)`` velocities to the steered velocities. All
        times must be equal; 0 is noise and 1 is data.
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
