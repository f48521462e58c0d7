# SPDX-License-Identifier: Apache-2.0
"""Where guidance enters the generation of a policy that is not ours.

    base                                        guided
    diffusion, multi_task_dit (diffusion)       in every denoising step: the noise scheduler is wrapped
    multi_task_dit (flow matching, Euler)       in every integration step, noise at t = 0: the velocity is wrapped
    pi0, pi05, smolvla                          in every integration step, noise at t = 1: the velocity is wrapped
    act, vqbet, pi0_fast, tdmpc, all others     on the finished chunk

What is wrapped is wrapped for one call. Nothing of the base is replaced for good.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide
from lerobot_pf2mp.policies.guided.guided_scheduler import guided_scheduler

# Steps of guidance on a finished chunk: as many as `fmp` integrates by default.
N_STEPS_AT_THE_END = 5


class Generation(Protocol):
    """The place at which a policy's generation is guided."""

    # How it is said to users.
    where: str

    def guided(self, guide: Guide | None) -> AbstractContextManager[None]:
        """A block in which the policy's steps are guided; without a guide, or without steps, nothing changes."""

    def finished(self, chunk: Tensor, guide: Guide | None) -> Tensor:
        """A chunk ``(B, T, A)`` that was generated in such a block, guided as far as it has not been [normalised]."""


# Policies that generate a chunk in one go, as far as they are known.
KNOWN_AT_THE_END = ("act", "pi0_fast", "tdmpc", "vqbet")


def generation_of(base: PreTrainedPolicy) -> Generation:
    """Where the generation of a policy is guided, under its present options.

    Args:
        base: The policy.
    """
    policy: Any = base
    config = policy.config
    action_dim = config.action_feature.shape[0]
    match config.type:
        case "diffusion":
            return InDenoisingSteps(policy.diffusion)
        case "multi_task_dit" if config.is_diffusion:
            return InDenoisingSteps(policy.objective)
        case "multi_task_dit" if config.integration_method == "euler":
            steps = VelocitySteps(config.num_integration_steps, True, action_dim)
            return InIntegrationSteps(policy.noise_predictor, "forward", steps)
        case "pi0" | "pi05":
            steps = VelocitySteps(config.num_inference_steps, False, action_dim)
            return InIntegrationSteps(policy.model, "denoise_step", steps)
        case "smolvla" if (
            not config.adapt_to_pi_aloha
        ):  # which generates actions in other units than the dataset's
            steps = VelocitySteps(config.num_steps, False, action_dim)
            return InIntegrationSteps(policy.model, "denoise_step", steps)
    return AtTheEnd()


@dataclass(frozen=True)
class AtTheEnd:
    """Guidance of policies that generate a chunk in one go: the same steps on the finished chunk."""

    where = "on the finished chunk"

    def guided(self, guide: Guide | None) -> AbstractContextManager[None]:
        """Changes nothing."""
        return nullcontext()

    def finished(self, chunk: Tensor, guide: Guide | None) -> Tensor:
        """The chunk after `N_STEPS_AT_THE_END` steps of guidance, in which no flow moves it."""
        if guide is None:
            return chunk
        x = chunk.float()
        for _ in range(N_STEPS_AT_THE_END):
            x = guide(x, x, x, 1 / N_STEPS_AT_THE_END)
        return x.to(chunk.dtype)


@dataclass(frozen=True)
class InDenoisingSteps:
    """Guidance of policies that denoise with a noise scheduler of diffusers.

    Args:
        owner: What holds the scheduler.
    """

    owner: Any
    where = "in every denoising step"

    def guided(self, guide: Guide | None) -> AbstractContextManager[None]:
        """Wraps the scheduler."""
        return guided_scheduler(self.owner, guide)

    def finished(self, chunk: Tensor, guide: Guide | None) -> Tensor:
        """The chunk itself."""
        return chunk


@dataclass(frozen=True)
class VelocitySteps:
    """The Euler steps of a policy that integrates a velocity, and how guidance changes one of them.

    Args:
        n_steps: Number of steps N, each of the length 1/N.
        is_forward: Whether time runs from noise at 0 to actions at 1; otherwise from noise at 1 to actions at 0.
        action_dim: Number of action dimensions A. The network's may have more, which are padding and stay as they are.
    """

    n_steps: int
    is_forward: bool
    action_dim: int

    def guided_velocity(self, velocity: Tensor, x_t: Tensor, time: Tensor, guide: Guide) -> Tensor:
        """The velocity v' with which the unguided step from x_t becomes the guided one.

        With time from 1 to 0, x_next = x_t - dt v and x_1 = x_t - t v; forward, x_next = x_t + dt v and
        x_1 = x_t + (1 - t) v. In both, v' - v is the offset of the guided point divided by the signed dt. No gradient runs
        through the offset: the correction of real-time chunking, which differentiates v', is that of the unguided policy.

        Args:
            velocity: ``(B, T, A')`` the network's velocity at x_t, A' >= A.
            x_t: ``(B, T, A')`` the start of the step.
            time: ``(B,)`` or ``()`` the time at which it starts.
            guide: The guide.
        """
        with torch.no_grad():
            dt = 1 / self.n_steps
            sign, left = (1, 1 - time) if self.is_forward else (-1, time)
            x, v = (value.detach()[..., : self.action_dim].float() for value in (x_t, velocity))
            x_next = x + sign * dt * v
            x_1 = x + sign * left.to(x).reshape(-1, 1, 1) * v
            offset = (guide(x, x_next, x_1, dt) - x_next) / (sign * dt)
            offset = torch.nn.functional.pad(offset, (0, velocity.shape[-1] - self.action_dim))
        return velocity + offset.to(velocity.dtype)


@dataclass(frozen=True)
class InIntegrationSteps:
    """Guidance of policies that integrate a velocity.

    Args:
        owner: The module whose method is the velocity.
        method: Its name; x_t and the time are its arguments ``x_t`` and ``timestep``, or the first two.
        steps: The steps.
    """

    owner: Any
    method: str
    steps: VelocitySteps
    where = "in every integration step"

    @contextmanager
    def guided(self, guide: Guide | None) -> Iterator[None]:
        """Wraps the method of this one module."""
        if guide is None:
            yield
            return
        velocity = getattr(self.owner, self.method)

        def guided_velocity(*args: Any, **kwargs: Any) -> Tensor:
            x_t, time = args[:2] if args else (kwargs["x_t"], kwargs["timestep"])
            return self.steps.guided_velocity(velocity(*args, **kwargs), x_t, time, guide)

        setattr(self.owner, self.method, guided_velocity)
        try:
            yield
        finally:
            delattr(self.owner, self.method)  # the class's own shows again

    def finished(self, chunk: Tensor, guide: Guide | None) -> Tensor:
        """The chunk itself."""
        return chunk
