# SPDX-License-Identifier: Apache-2.0
"""Gives all policies the same prior noise, so that they can be compared episode by episode."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from lerobot.policies import PreTrainedPolicy


@contextmanager
def seeded_prior_noise(policy: PreTrainedPolicy, repeat: int) -> Iterator[None]:
    """Seeds the noise of every chunk by repeat, rollout and chunk.

    Policies that draw noise of the same shape at the beginning of `predict_action_chunk`, as flow matching and diffusion
    policies do, then start from the same samples. A rollout begins with the policy's `reset`.

    Args:
        policy: The policy; it is unchanged after the block.
        repeat: Number of the repeat.
    """
    reset, predict = policy.reset, policy.predict_action_chunk
    rollout, chunk = -1, 0

    def seed() -> None:
        (state,) = np.random.SeedSequence((repeat, max(rollout, 0), chunk)).generate_state(1)
        torch.manual_seed(int(state))

    def seeded_reset() -> None:
        nonlocal rollout, chunk
        rollout, chunk = rollout + 1, 0
        seed()
        reset()

    def seeded_predict(*args: Any, **kwargs: Any) -> Any:
        nonlocal chunk
        seed()
        chunk += 1
        return predict(*args, **kwargs)

    policy.reset, policy.predict_action_chunk = seeded_reset, seeded_predict  # type: ignore[method-assign]
    try:
        yield
    finally:
        del policy.reset, policy.predict_action_chunk
