# SPDX-License-Identifier: Apache-2.0
"""Real-time chunking (Black et al., 2025, arXiv:2506.07339): a new chunk continues the one that is being executed.

The method is LeRobot's. LeRobot counts time from 1 (noise) to 0 (data). Only this file converts between the directions.
"""

from __future__ import annotations

from contextlib import nullcontext

import torch
from lerobot.policies.rtc.modeling_rtc import RTCProcessor
from torch import Tensor

from lerobot_pf2mp.flow_matching import Steer


def is_committed(left_over: Tensor) -> Tensor:
    """Which actions of a left-over are ones of the last chunk that a new chunk must continue.

    LeRobot's engine appends zeros to a short left-over: a robot that took them for actions would go to the middle of its
    range. And an action that is not finite, or comes after one, cannot be continued.

    Args:
        left_over: ``(..., T_left, A)`` actions of the last chunk that have not been executed [normalised].

    Returns:
        ``(..., T_left)`` bool, true up to the last row before the first that is not finite and before the zeros at the end.
    """
    is_finite = left_over.isfinite().all(dim=-1).long().cumprod(dim=-1)
    is_action = (left_over != 0).any(dim=-1).long()
    is_before_zeros = is_action.flip(-1).cummax(dim=-1).values.flip(-1)
    return (is_finite * is_before_zeros).bool()


def n_executed_of(chunk: Tensor, left_over: Tensor) -> int | None:
    """How many actions of a chunk had been executed when a left-over of it was taken.

    LeRobot's engine cuts long left-overs, so their length does not tell.

    Args:
        chunk: ``(B, T, A)`` the chunk.
        left_over: ``([B,] T_left, A)`` its left-over, perhaps cut, or with zeros at its end.

    Returns:
        The number, T if nothing is left; None if the left-over is of another chunk.
    """
    if left_over.ndim == 3 and len(left_over) not in (1, len(chunk)):
        return None
    left_over = left_over.expand(len(chunk), *left_over.shape[-2:]).to(chunk)
    n_left = int(is_committed(left_over).sum(dim=-1).amin())
    if n_left == 0:
        return chunk.shape[1]
    for start in range(chunk.shape[1] - n_left + 1):
        if torch.equal(chunk[:, start : start + n_left], left_over[:, :n_left]):
            return start
    return None


def continuing(
    processor: RTCProcessor, left_over: Tensor, inference_delay: int, execution_horizon: int | None = None
) -> Steer:
    """A function that steers the flow towards chunks that begin with the remaining actions of the last chunk.

    Args:
        processor: LeRobot's RTC processor, with its weights and schedule.
        left_over: ``([B,] T_left, A)`` actions of the last chunk that have not been executed [normalised]. Only those that
            are committed count, see `is_committed`.
        inference_delay: Steps that will be executed before the new chunk is available. Their actions stay unchanged.
        execution_horizon: Number of steps over which the new chunk is pulled towards the old one; None for the value of
            the processor.

    Returns:
        A function that maps ``(B, T, A)`` points, ``(B,)`` times and ``(B, T, A)`` velocities to the steered velocities. All
        times must be equal; 0 is noise and 1 is data.
    """
    is_real = is_committed(left_over).unsqueeze(-1)

    def steer(x_t: Tensor, t: Tensor, velocity: Tensor) -> Tensor:
        time = float(1 - t[0])
        # The processor pulls the predicted end point towards the left-over: where there is none, towards itself.
        n_steps, end = left_over.shape[-2], x_t + time * velocity
        wanted = torch.where(
            is_real[..., : x_t.shape[1], :], left_over[..., : x_t.shape[1], :], end[:, :n_steps]
        )
        # The processor takes a gradient, which is impossible in inference mode.
        with torch.inference_mode(False) if torch.is_inference_mode_enabled() else nullcontext():
            backward = processor.denoise_step(
                x_t=x_t.clone(),
                prev_chunk_left_over=wanted.clone(),
                inference_delay=inference_delay,
                time=time,
                original_denoise_step_partial=lambda _: -velocity.clone(),
                execution_horizon=execution_horizon,
            )
        return -backward

    return steer
