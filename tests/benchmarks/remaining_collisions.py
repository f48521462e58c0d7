# SPDX-License-Identifier: Apache-2.0
"""What the collisions are that remain with guidance and checked plans: one episode of each kind, and their figure.

    python tests/benchmarks/remaining_collisions.py

runs the very episodes of the benchmarks (same starts, same prior noise, same batch) with the checkpoints and datasets of
the README, prints what touches where, and draws results/remaining_light.png and results/remaining_dark.png. It takes a
minute on one core.
"""

from __future__ import annotations

import io
from contextlib import redirect_stderr
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from collision_figure import plot_collisions
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import make_env_pre_post_processors
from lerobot.envs.configs import EnvConfig
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor
from touch import Touch, TouchRecorder

from lerobot_pf2mp import PF2MPFetchEnv, PF2MPMazeEnv, load_policy
from lerobot_pf2mp.benchmark.prior_noise import seeded_prior_noise
from lerobot_pf2mp.benchmark.spec import BenchmarkSpec

EPISODE_SEED, BATCH_SIZE = BenchmarkSpec.episode_seed, BenchmarkSpec.batch_size
NEAR = 0.03  # a demonstration passes there if it comes closer than this [m]
_STEP = 0.002  # between two points of a way [m]


@dataclass
class RemainingCollisionsConfig:
    """Runs the episodes and draws the figure."""

    # Folder of the checkpoints, as the README's commands write them.
    outputs: Path = Path("outputs")
    # Folder of the datasets.
    data: Path = Path("data")
    # Folder to write the two figures into.
    output_dir: Path = Path("results")


@dataclass(frozen=True)
class Case:
    """An episode of a benchmark, with proximal guidance, lambda = 0.8."""

    env: EnvConfig
    checkpoint: str
    dataset: str
    repeat: int
    episode: int


_LAST = "pf2mp_0/checkpoints/last/pretrained_model"
CASES = {
    "reach": Case(
        PF2MPFetchEnv(task="FetchReachWall-v0"), f"FetchReachWall-v0/{_LAST}", "fetch_reach", 2, 164
    ),
    "push": Case(PF2MPFetchEnv(task="FetchPushWall-v0"), f"FetchPushWall-v0/{_LAST}", "fetch_push", 0, 137),
    "maze": Case(PF2MPMazeEnv(task="MazeMedium-v0"), "MazeMedium-v0/dppf_0", "maze_medium", 0, 471),
}


@dataclass(frozen=True)
class Episode:
    """What a robot planned and did, and what was demonstrated. All positions in metres.

    Args:
        env: The environment's configuration.
        plan: ``(T + 1, D)`` the start and the executed plan.
        other_plans: Those drawn beside it, ``(T + 1, D)`` each.
        is_supported: ``(T,)`` whether the way to each action is.
        path: ``(N, D)`` where the robot went.
        block_path: ``(N, D)`` where the block went; empty without one.
        goal: ``(D,)`` the goal.
        demonstrations: ``(T, D)`` actions of each demonstration.
        block_demonstrations: ``(T, D)`` positions of the block in each; empty without one.
        touch: The deepest touch, in Fetch.
        contact: ``(D,)`` where it touched the wall.
        clearance: The smallest clearance.
    """

    env: Any
    plan: np.ndarray
    other_plans: list[np.ndarray]
    is_supported: np.ndarray
    path: np.ndarray
    block_path: np.ndarray
    goal: np.ndarray
    demonstrations: list[np.ndarray]
    block_demonstrations: list[np.ndarray]
    touch: Touch | None
    contact: np.ndarray
    clearance: float


def main(config: RemainingCollisionsConfig) -> None:
    """Runs the episodes, prints what remains, and draws it."""
    torch.set_num_threads(1)
    episodes = {
        name: record(case, config.outputs / case.checkpoint, config.data / case.dataset)
        for name, case in CASES.items()
    }
    facts = {name: measure(episode) for name, episode in episodes.items()}
    for name, values in facts.items():
        print(name, ", ".join(f"{key}: {value:.4g}" for key, value in values.items()))
    for background in ("light", "dark"):
        output = config.output_dir / f"remaining_{background}.png"
        plot_collisions(output, episodes=episodes, facts=facts, background=background)


def record(case: Case, checkpoint: Path, dataset: Path) -> Episode:
    """Runs the batch that holds an episode, and keeps that one."""
    policy, preprocess, postprocess = load_policy(
        checkpoint, device="cpu", guidance_integrator="proximal", guidance_scale=0.8
    )
    policy_: Any = policy
    policy_.guidance.measures_plans = True
    (env,) = next(iter(case.env.create_envs(BATCH_SIZE, use_async_envs=False).values())).values()
    n_before, row = divmod(case.episode, BATCH_SIZE)
    robot = env.envs[row].unwrapped
    is_fetch = isinstance(case.env, PF2MPFetchEnv)
    recorder = TouchRecorder(robot) if is_fetch else None
    drawn = watch_plans(policy_, row)
    # stderr gets LeRobot's progress bar.
    with seeded_prior_noise(policy, case.repeat), redirect_stderr(io.StringIO()):
        for _ in range(n_before):
            policy.reset()  # the noise depends on the number of the rollout
        result = rollout(
            env,
            policy,
            *make_env_pre_post_processors(case.env, policy_.config),
            preprocess,
            postprocess,
            seeds=[EPISODE_SEED + n_before * BATCH_SIZE + i for i in range(BATCH_SIZE)],
            return_observations=True,
        )
    states, others = (result["observation"][key][row].numpy() for key in (OBS_STATE, OBS_ENV_STATE))
    plan = np.concatenate([states[:1], result[ACTION][row].numpy()])
    is_supported = policy_.plans.action_support[row].numpy() >= 0
    actions, environments = read_episodes(dataset, ACTION), read_episodes(dataset, OBS_ENV_STATE)
    has_block = others.shape[1] == 6
    touch = recorder.touch if recorder else None
    contact, clearance = (
        (touch.point, -touch.depth) if touch else deepest_point(robot._swept_ball, plan.astype(float))
    )
    env.close()
    return Episode(
        env=case.env,
        plan=plan,
        other_plans=[np.concatenate([plan[:1], postprocess(other).numpy()]) for other in drawn],
        is_supported=is_supported,
        path=recorder.gripper_path if recorder else states,
        block_path=recorder.block_path if recorder and has_block else np.empty((0, 3)),
        goal=others[0, -plan.shape[1] :],
        demonstrations=actions,
        block_demonstrations=[each[:, :3] for each in environments] if has_block else [],
        touch=touch,
        contact=contact,
        clearance=clearance,
    )


def watch_plans(policy: Any, row: int) -> list[Tensor]:
    """A list that gets the plans ``(T, A)`` that a policy draws for a robot beside its first one [normalised]."""
    drawn: list[Tensor] = []
    choose = policy.guidance.choose

    def watched(batch: dict[str, Any], chunk: Tensor, draw_more: Any) -> Tensor:
        def watched_draw(rows: Tensor, n: int) -> Tensor:
            more = draw_more(rows, n)  # (F n, T, A)
            for place in (rows == row).nonzero().flatten().tolist():
                drawn.extend([chunk[row].clone(), *more[place * n : (place + 1) * n].clone()])
            return more

        return choose(batch, chunk, watched_draw)

    policy.guidance.choose = watched
    return drawn


def read_episodes(root: Path, key: str) -> list[np.ndarray]:
    """A column ``(T, D)`` of each episode of a dataset."""
    table = LeRobotDataset(f"local/{root.name}", root=root).hf_dataset.with_format("numpy")
    values, episodes = np.asarray(table[key][:]), np.asarray(table["episode_index"][:])
    return np.split(values, np.flatnonzero(np.diff(episodes)) + 1)


def deepest_point(ball: Any, plan: np.ndarray) -> tuple[np.ndarray, float]:
    """The point ``(2,)`` of a maze plan's way that is deepest in a wall, and the way's clearance [m]."""
    points = points_of(plan)
    clearances = [ball.clearance(point, point) for point in points]
    return points[int(np.argmin(clearances))], ball.path_clearance(plan)


def points_of(way: np.ndarray) -> np.ndarray:
    """Points ``(N, D)`` on the straight pieces of a way ``(T, D)`` [m]."""
    pieces = [
        np.linspace(start, end, 1 + int(np.ceil(np.linalg.norm(end - start) / _STEP)), endpoint=False)
        for start, end in pairwise(way)
    ]
    return np.concatenate([*pieces, way[-1:]])


def points_near(place: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Those of `points_of` that are less than `NEAR` from a place ``(D,)`` [m]."""
    points = points_of(way)
    return points[np.linalg.norm(points - place, axis=1) < NEAR]


def distance(place: np.ndarray, way: np.ndarray) -> float:
    """The distance of a place ``(D,)`` from the straight pieces of a way ``(T, D)`` [m]."""
    steps = np.diff(way.astype(float), axis=0)
    along = ((place - way[:-1]) * steps).sum(axis=1) / np.maximum((steps * steps).sum(axis=1), 1e-12)
    nearest = way[:-1] + along.clip(0, 1)[:, None] * steps
    return float(np.linalg.norm(nearest - place, axis=1).min())


def measure(episode: Episode) -> dict[str, float]:
    """The numbers of the figure: distances [mm], and counts."""
    touch = episode.touch
    if touch is None:
        jumps = np.linalg.norm(np.diff(episode.plan, axis=0), axis=1)
        return {
            "clearance": 1000 * episode.clearance,
            "longest_step": 1000 * float(jumps.max()),
            "n_unsupported_steps": int((~episode.is_supported).sum()),
            "n_plans": len(episode.other_plans),
        }
    of_part = episode.block_demonstrations if touch.part == "block" else episode.demonstrations
    distances = [distance(touch.centre, way) for way in of_part]
    passing = [points_near(touch.centre, way) for way in of_part]
    passing = [points for points in passing if len(points)]
    facts = {
        "depth": 1000 * touch.depth,
        "off_plan": 1000 * distance(touch.gripper, episode.plan),
        "nearest_demonstration": 1000 * min(distances),
        "n_demonstrations_near": len(passing),
        "their_clearance": 1000 * min(float(touch.clearances(points).min()) for points in passing),
    }
    if touch.part == "hand":
        plan = points_near(touch.gripper, episode.plan)
        facts["depth_of_plan"] = -1000 * float(touch.clearances(plan).min())
    return facts


if __name__ == "__main__":
    main(draccus.parse(RemainingCollisionsConfig))
