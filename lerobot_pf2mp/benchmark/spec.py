# SPDX-License-Identifier: Apache-2.0
"""The specification of a benchmark."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lerobot.envs.configs import EnvConfig

from lerobot_pf2mp.guidance import GUIDANCE_INTEGRATORS
from lerobot_pf2mp.results.rows import NO_GUIDANCE


@dataclass(frozen=True)
class Guidance:
    """One kind of guidance.

    Args:
        integrator: One of `GUIDANCE_INTEGRATORS`, or none.
        scale: lambda; 0 without guidance.
    """

    integrator: str
    scale: float

    @classmethod
    def parse(cls, text: str) -> list[Guidance]:
        """Reads ``none``, or ``INTEGRATOR:SCALE,SCALE,...``, for example ``proximal:0.08,0.8``.

        Raises:
            ValueError: If the text is neither.
        """
        if text == NO_GUIDANCE:
            return [NONE]
        integrator, _, scales = text.partition(":")
        try:
            values = [float(scale) for scale in scales.split(",")]
        except ValueError:
            values = [-1.0]
        if integrator not in GUIDANCE_INTEGRATORS or not all(0 < value < float("inf") for value in values):
            raise ValueError(
                f"guidance must be none or INTEGRATOR:SCALE,SCALE,... with an integrator of {GUIDANCE_INTEGRATORS} and "
                f"positive scales, got {text!r}"
            )
        return [cls(integrator, value) for value in values]


NONE = Guidance(NO_GUIDANCE, 0.0)


@dataclass(frozen=True)
class BenchmarkSpec:
    """The policies, guidance, tasks and episodes of a benchmark.

    Args:
        env: The environments' configuration.
        tasks: Tasks of the environment.
        policies: Checkpoints (``pretrained_model`` folders or repositories on the Hub) by name. ``{task}`` and ``{seed}``
            in a path stand for the task and the training seed. Policies of any type can be compared.
        guidances: Kinds of guidance for policies that have one. ``none`` is the same policy without
            guidance, which draws one plan only, unless the variant names ``max_plans``.
        variants: Changes to the policies' configuration by name; the name "" without changes is the unchanged checkpoint.
        seeds: Training seeds.
        n_repeats: Repeats with other prior noise.
        n_episodes: Number of start-goal pairs, the same pairs for all.
        episode_seed: Seed of the first pair; pair i has `episode_seed` + i.
        batch_size: Number of parallel environments.
        device: Device on which the policies run.

    Raises:
        ValueError: If a number is not positive, there is nothing to compare, or something would be compared twice.
    """

    env: EnvConfig
    tasks: tuple[str, ...]
    policies: dict[str, str]
    guidances: tuple[Guidance, ...]
    variants: dict[str, dict[str, Any]]
    seeds: tuple[int, ...] = (0,)
    n_repeats: int = 3
    n_episodes: int = 500
    episode_seed: int = 100000
    batch_size: int = 50
    device: str = "cpu"

    def __post_init__(self) -> None:
        for name in ("n_repeats", "n_episodes", "batch_size"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("tasks", "policies", "guidances", "variants", "seeds"):
            if not getattr(self, name):
                raise ValueError(f"{name} must name at least one, got none")
        for name in ("tasks", "guidances", "seeds"):
            values = list(getattr(self, name))
            if len(set(values)) < len(values):
                raise ValueError(f"{name} must differ from each other, got {values}")
        for policy, path in self.policies.items():
            if len(self.seeds) > 1 and "{seed}" not in path:
                raise ValueError(
                    f"with several seeds the path of {policy!r} must hold {{seed}}, got {path} and the seeds {self.seeds}"
                )
        for variant, options in self.variants.items():
            for option in ("guidance_scale", "guidance_integrator"):
                if option in options:
                    raise ValueError(f"{option} must be given as guidance, got it in the variant {variant!r}")


@dataclass(frozen=True)
class Job:
    """One repeat of one policy with one kind of guidance. It is evaluated as a whole or not at all.

    Args:
        task: The environment's task.
        policy: Name of the policy; without guidance its unguided name.
        checkpoint: Folder or repository from which it is loaded.
        guidance: The kind of guidance.
        variant: Name of the changes to its configuration.
        seed: Training seed.
        repeat: Number of the repeat.
    """

    task: str
    policy: str
    checkpoint: str
    guidance: Guidance
    variant: str
    seed: int
    repeat: int
