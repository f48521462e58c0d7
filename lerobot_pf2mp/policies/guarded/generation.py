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

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide
from lerobot_pf2mp.policies.guided.guided_scheduler import guided_scheduler
from lerobot_pf2mp.policies.guided.integrated_actions import guide_from_now_on

# Steps of guidance on a finished chunk. With ACT on the large maze and Fetch reach, two leave as few collisions as ten.
N_STEPS_AT_THE_END = 2


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


def generation_of(base: PreTrainedPolicy, n_steps: int | None = None) -> Generation:
    """Where the generation of a policy is guided, under its present options.

    Args:
        base: The policy.
        n_steps: Number of integration steps of this call; None for that of the configuration.
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
            steps = VelocitySteps(n_steps or config.num_inference_steps, False, action_dim)
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
        x, guide = chunk.float(), guide_from_now_on(guide)
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

    def guided_velocity(
        self, velocity: Tensor, x_t: Tensor, time: Tensor, guide: Guide, predicted: Tensor | None = None
    ) -> Tensor:
        """The velocity v' with which the unguided step from x_t becomes the guided one.

        With time from 1 to 0, x_next = x_t - dt v and x_1 = x_t - t v; forward, x_next = x_t + dt v and
        x_1 = x_t + (1 - t) v. In both, v' - v is the offset of the guided point divided by the signed dt. No gradient runs
        through it.

        Args:
            velocity: ``(B, T, A')`` the velocity of the step, A' >= A.
            x_t: ``(B, T, A')`` the start of the step.
            time: ``(B,)`` or ``()`` the time at which it starts.
            guide: The guide.
            predicted: ``(B, T, A')`` the velocity that leads to the end point x_1, if that is another one: the network's,
                when real-time chunking has corrected the step's.
        """
        with torch.no_grad():
            dt = 1 / self.n_steps
            sign, left = (1, 1 - time) if self.is_forward else (-1, time)
            end = velocity if predicted is None else predicted
            x, v, v_end = (value.detach()[..., : self.action_dim].float() for value in (x_t, velocity, end))
            x_next = x + sign * dt * v
            x_1 = x + sign * left.to(x).reshape(-1, 1, 1) * v_end
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

    def guided(self, guide: Guide | None) -> AbstractContextManager[None]:
        """Wraps the method of this one module, or the step of its processor for real-time chunking if that is on.

        The processor corrects a velocity by the end point to which it leads. If that were the guided one, the correction
        would undo the guidance, and more.
        """
        if guide is None:
            return nullcontext()
        processor = getattr(self.owner, "rtc_processor", None)
        if processor is not None and self.owner._rtc_enabled():
            return replaced(processor, "denoise_step", self._corrected(processor.denoise_step, guide))
        return replaced(self.owner, self.method, self._plain(getattr(self.owner, self.method), guide))

    def _plain(self, velocity: Callable[..., Tensor], guide: Guide) -> Callable[..., Tensor]:
        def guided_velocity(*args: Any, **kwargs: Any) -> Tensor:
            x_t, time = args[:2] if args else (kwargs["x_t"], kwargs["timestep"])
            return self.steps.guided_velocity(velocity(*args, **kwargs), x_t, time, guide)

        return guided_velocity

    def _corrected(self, correct: Callable[..., Tensor], guide: Guide) -> Callable[..., Tensor]:
        """The same for `RTCProcessor.denoise_step`, which calls the network's velocity once and corrects it."""

        def guided_velocity(
            *,
            x_t: Tensor,
            time: float,
            original_denoise_step_partial: Callable[[Tensor], Tensor],
            **kwargs: Any,
        ) -> Tensor:
            predicted: list[Tensor] = []

            def velocity(x: Tensor) -> Tensor:
                predicted.append(original_denoise_step_partial(x))
                return predicted[-1]

            corrected = correct(x_t=x_t, time=time, original_denoise_step_partial=velocity, **kwargs)
            return self.steps.guided_velocity(corrected, x_t, torch.as_tensor(time), guide, predicted[-1])

        return guided_velocity

    def finished(self, chunk: Tensor, guide: Guide | None) -> Tensor:
        """The chunk itself."""
        return chunk


@contextmanager
def replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    """A block in which an attribute of one object has another value. It is as before after the block."""
    before = vars(owner).get(name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        delattr(owner, name)  # the class's own shows again
        if before is not None:
            setattr(owner, name, before)
