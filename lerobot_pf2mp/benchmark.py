# SPDX-License-Identifier: Apache-2.0
"""Compares kinds of guidance of one checkpoint on the same episodes, with LeRobot's own evaluation."""

from __future__ import annotations

import csv
import os
import platform
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

import torch
from lerobot.envs import make_env_pre_post_processors
from lerobot.envs.configs import EnvConfig
from lerobot.scripts.lerobot_eval import eval_policy
from tqdm import tqdm

from lerobot_pf2mp.guidance import GUIDANCE_INTEGRATORS
from lerobot_pf2mp.loading import load_policy
from lerobot_pf2mp.rate import Rate


@dataclass(frozen=True)
class Guidance:
    """One kind of guidance.

    Args:
        integrator: One of `GUIDANCE_INTEGRATORS`.
        scale: lambda; 0 is no guidance, the plain flow matching policy.
    """

    integrator: str
    scale: float

    @classmethod
    def parse(cls, text: str) -> Guidance:
        """Reads ``fmp`` (no guidance) or ``INTEGRATOR:SCALE``, for example ``proximal:0.8``.

        Raises:
            ValueError: If the text is neither.
        """
        if text == "fmp":
            return cls(GUIDANCE_INTEGRATORS[0], 0.0)
        integrator, _, scale = text.partition(":")
        try:
            value = float(scale)
        except ValueError:
            value = -1.0
        if integrator not in GUIDANCE_INTEGRATORS or not value > 0:
            raise ValueError(
                f"guidance must be fmp or INTEGRATOR:SCALE with an integrator of {GUIDANCE_INTEGRATORS} and a "
                f"positive scale, got {text!r}"
            )
        return cls(integrator, value)


@dataclass(frozen=True)
class Result:
    """The outcome of one repeat: the same episodes for every kind of guidance, other noise for every repeat.

    Args:
        task: The environment's task.
        policy: fmp without guidance, pf2mp with it.
        guidance_integrator: Its integrator; empty without guidance.
        guidance_scale: lambda.
        seed: Seed of the first episode's start and goal; episode i has seed + i.
        repeat: Number of the repeat; the noise of the policy is seeded with it.
        n_episodes: Episodes.
        collisions: Episodes with a collision.
        successes: Episodes that reached the goal.
    """

    task: str
    policy: str
    guidance_integrator: str
    guidance_scale: float
    seed: int
    repeat: int
    n_episodes: int
    collisions: int
    successes: int


def run_benchmark(
    checkpoint: Path,
    env: EnvConfig,
    guidances: Sequence[Guidance],
    *,
    n_episodes: int,
    n_repeats: int,
    seed: int,
    batch_size: int = 50,
) -> list[Result]:
    """Evaluates a checkpoint once for each kind of guidance and repeat.

    Args:
        checkpoint: A ``pretrained_model`` folder of a pf2mp policy.
        env: The environment.
        guidances: The kinds of guidance to compare.
        n_episodes: Start-goal pairs, the same for all.
        n_repeats: Repeats with other noise.
        seed: Seed of the first pair.
        batch_size: Environments that run side by side.

    Returns:
        One result for each kind of guidance and repeat.

    Raises:
        ValueError: If a number is not positive.
    """
    for name, value in (("n_episodes", n_episodes), ("n_repeats", n_repeats), ("batch_size", batch_size)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    policy, preprocessor, postprocessor = load_policy(checkpoint, device="cpu")
    env_preprocessor, env_postprocessor = make_env_pre_post_processors(env, policy.config)
    (vector_env,) = next(iter(env.create_envs(min(batch_size, n_episodes)).values())).values()
    cells = [(guidance, repeat) for guidance in guidances for repeat in range(n_repeats)]
    results = []
    for guidance, repeat in tqdm(cells, desc="Benchmark", unit="repeat"):
        policy.config.guidance_integrator = guidance.integrator
        policy.config.guidance_scale = guidance.scale
        torch.manual_seed(repeat)
        episodes = eval_policy(
            vector_env,
            policy,
            env_preprocessor,
            env_postprocessor,
            preprocessor,
            postprocessor,
            n_episodes,
            start_seed=seed,
        )["per_episode"]
        results.append(
            Result(
                task=str(env.task),
                policy="pf2mp" if guidance.scale else "fmp",
                guidance_integrator=guidance.integrator if guidance.scale else "",
                guidance_scale=guidance.scale,
                seed=seed,
                repeat=repeat,
                n_episodes=n_episodes,
                collisions=sum(episode["sum_reward"] < 0 for episode in episodes),
                successes=sum(episode["success"] for episode in episodes),
            )
        )
    vector_env.close()
    return results


def write_results(path: Path, results: Iterable[Result]) -> None:
    """Writes results as CSV, with the versions and the hardware they were made with."""
    made_with = {
        **{name: version(name) for name in ("lerobot", "torch", "mujoco", "gymnasium-robotics")},
        "python": platform.python_version(),
        "machine": f"{platform.machine()} {os.cpu_count()} cores",
    }
    rows = [{**asdict(result), **made_with} for result in results]
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    partial.replace(path)


def make_table(results: Iterable[Result]) -> str:
    """A Markdown table: mean and standard deviation over the repeats [%], and the 95 % interval of all episodes."""
    cells: dict[tuple[str, str, float], list[Result]] = {}
    for result in results:
        key = (result.task, result.guidance_integrator, result.guidance_scale)
        cells.setdefault(key, []).append(result)
    lines = [
        "| task | policy | guidance | lambda | collision rate [%] | 95 % interval | success rate [%] | episodes |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for (task, integrator, scale), repeats in cells.items():
        n_episodes = sum(result.n_episodes for result in repeats)
        low, high = Rate(sum(result.collisions for result in repeats), n_episodes).interval
        collision = _mean_and_deviation([100 * result.collisions / result.n_episodes for result in repeats])
        success = _mean_and_deviation([100 * result.successes / result.n_episodes for result in repeats])
        lines.append(
            f"| {task} | {repeats[0].policy} | {integrator or 'none'} | {scale:g} | {collision} "
            f"| {100 * low:.2f} to {100 * high:.2f} | {success} | {len(repeats)} x {repeats[0].n_episodes} |"
        )
    return "\n".join(lines)


def _mean_and_deviation(values: list[float]) -> str:
    deviation = statistics.stdev(values) if len(values) > 1 else 0.0
    return f"{statistics.mean(values):.2f} ± {deviation:.2f}"
