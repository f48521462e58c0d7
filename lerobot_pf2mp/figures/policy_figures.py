# SPDX-License-Identifier: Apache-2.0
"""Collects the contents of the figures from results and checkpoints."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from lerobot.envs import make_env_pre_post_processors
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, preprocess_observation
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from lerobot_pf2mp import figures
from lerobot_pf2mp.benchmark.prior_noise import seeded_prior_noise
from lerobot_pf2mp.envs.configs.fetch import PF2MPFetchEnv
from lerobot_pf2mp.envs.configs.handwriting import PF2MPHandwritingEnv
from lerobot_pf2mp.envs.configs.maze import PF2MPMazeEnv
from lerobot_pf2mp.envs.configs.metaworld import PF2MPMetaWorldEnv
from lerobot_pf2mp.envs.maze.point_maze import parse_maze_map
from lerobot_pf2mp.envs.tasks import MAZE_TASKS
from lerobot_pf2mp.field_report.examination import make_field_report
from lerobot_pf2mp.figures import Path2D, PathPair, Scene
from lerobot_pf2mp.figures.comparison_video import write_comparison
from lerobot_pf2mp.figures.support import plot_support
from lerobot_pf2mp.loading import load_policy, loaded_demonstrations
from lerobot_pf2mp.policies.batch_keys import POTENTIAL_FIELD
from lerobot_pf2mp.policies.guided.configuration_guided import GuidedConfig
from lerobot_pf2mp.policies.guided.field_settings import INTEGRATED
from lerobot_pf2mp.results.rows import SummaryRow, read_rows
from lerobot_pf2mp.results.summary import group_cells

FIGURES = ("lambda", "density", "arrows", "trajectories", "overview", "strokes", "flow", "video", "support")

# Figures of what robots do, not of the field.
_OF_STATES = ("trajectories", "video")

_N_SEARCHED = 100  # episodes among which the clearest ones are chosen


def make_lambda_figure(results: Sequence[Path], output: Path, *, task: str | None, background: str) -> None:
    """Draws rates against lambda, from the ``summary.csv`` of one or several benchmarks.

    Args:
        results: The files, or their folders.
        output: The PNG file to write.
        task: The task whose results are drawn; None if there is only one.
        background: light or dark.

    Raises:
        ValueError: If the results are of several tasks and `task` is None, or no result is guided.
        FileNotFoundError: If there is no such file.
    """
    rows: list[SummaryRow] = []
    for path in results:
        rows += read_rows(path / "summary.csv" if path.is_dir() else path, SummaryRow)
    figures.plot_lambda(
        output, cells=group_cells(row for row in rows if task in (None, row.task)), background=background
    )


def make_support_figure(
    checkpoint: str | Path, output: Path, *, options: dict[str, Any] | None = None, background: str
) -> None:
    """Draws the support of the demonstrations that a checkpoint holds. It needs no environment and no dataset.

    Args:
        checkpoint: A pf2mp, dppf or guarded checkpoint.
        output: The PNG file to write.
        options: Changes to the policy's configuration.
        background: light or dark.

    Raises:
        ValueError: If the policy has no potential field.
    """
    policy, preprocessor, _ = load_policy(checkpoint, device="cpu", **(options or {}))
    config: Any = policy.config
    report = make_field_report(
        loaded_demonstrations(preprocessor), source=f"checkpoint {checkpoint}", settings=config.field_settings
    )
    plot_support(output, report=report, background=background)


class GuidedPolicyFigures:
    """Figures of one guided policy in one environment.

    Args:
        checkpoint: A pf2mp, dppf or guarded checkpoint.
        env: The environment.
        seed: Seed of the first episode; episode i has seed + i.
        options: Changes to the policy's configuration.

    Raises:
        ValueError: If the policy has no guidance.
    """

    def __init__(
        self, checkpoint: str | Path, env: EnvConfig, *, seed: int, options: dict[str, Any] | None = None
    ) -> None:
        self._policy, self._preprocess, self._postprocess = load_policy(
            checkpoint, device="cpu", **(options or {})
        )
        if not isinstance(self._policy.config, GuidedConfig):
            raise ValueError(
                f"the checkpoint must be of type pf2mp, dppf or guarded, got {self._policy.config.type!r}"
            )
        self._config: Any = self._policy.config
        self._env = env
        self._seed = seed

    def draw(
        self, figure: str, output: Path, n_episodes: int, episodes: Sequence[int], background: str
    ) -> None:
        """Writes one of `FIGURES` except lambda and support.

        Args:
            figure: Its name.
            output: The file to write.
            n_episodes: Number of episodes to draw if `episodes` is empty; for flow, number of chunks.
            episodes: Numbers of the episodes to draw.
            background: light or dark.

        Raises:
            ValueError: If the figure cannot be drawn of this policy in this environment.
        """
        if self._config.field_over == INTEGRATED and figure not in _OF_STATES:
            raise ValueError(
                f"the figure of a policy with field_over=integrated must be one of {_OF_STATES}, got {figure}: its actions "
                "are displacements"
            )
        scene = self.scene()
        if figure == "density":
            figures.plot_density(output, scene=scene, background=background)
        elif figure == "arrows":
            figures.plot_arrows(output, scene=scene, background=background)
        elif figure == "trajectories":
            pairs = self.path_pairs(n_episodes, episodes)
            figures.plot_trajectories(output, scene=scene, pairs=pairs, background=background)
        elif figure == "strokes":
            pairs = self.path_pairs(0, episodes or range(n_episodes))
            figures.plot_strokes(output, scene=scene, pairs=pairs, background=background)
        elif figure == "overview":
            pair = self.path_pairs(1, episodes[:1])[0]
            figures.plot_maze_overview(output, scene=scene, pair=pair, background=background)
        elif figure == "video":
            (pair,) = self.path_pairs(1, episodes[:1])
            write_comparison(
                output, *self.video_frames(pair), collisions=_first_collisions(pair), background=background
            )
        else:
            unguided, guided, starts, goals = self.trace_flow(n_episodes)
            figures.animate_flow(
                output,
                scene=scene,
                unguided=unguided,
                guided=guided,
                starts=starts,
                goals=goals,
                background=background,
            )

    def scene(self) -> Scene:
        """The potential field and the map of the environment."""
        demonstrations = self._preprocess({OBS_STATE: torch.zeros(self._config.robot_state_feature.shape)})[
            POTENTIAL_FIELD
        ]
        field = demonstrations.field(self._config.field_settings)
        env = self._env
        if isinstance(env, PF2MPMazeEnv):
            return Scene(self._postprocess, field, parse_maze_map(env.maze_map or MAZE_TASKS[str(env.task)]))
        if isinstance(env, PF2MPHandwritingEnv):
            return Scene(self._postprocess, field, writing=env.scene)
        has_wall = isinstance(env, PF2MPFetchEnv | PF2MPMetaWorldEnv)
        return Scene(self._postprocess, field, obstacles=[env.wall] if has_wall else ())

    def path_pairs(self, n_pairs: int, episodes: Sequence[int] = ()) -> list[PathPair]:
        """Runs episodes without and with guidance, from the same start and prior noise.

        Args:
            n_pairs: Number of pairs to return.
            episodes: Numbers of the episodes. By default they are chosen from the first hundred: first those in which
                guidance prevents a collision, then those with the longest path.
        """
        n_episodes = max(episodes) + 1 if episodes else _N_SEARCHED
        unguided, goals = self._roll_out(n_episodes, 0.0)
        guided, _ = self._roll_out(n_episodes, self._config.guidance_scale)
        pairs = [PathPair(i, unguided[i], guided[i], goals[i], n_episodes) for i in range(n_episodes)]
        if episodes:
            return [pairs[i] for i in episodes]
        return sorted(pairs, key=_clarity, reverse=True)[:n_pairs]

    def video_frames(self, pair: PathPair) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Images ``(H, W, 3)`` uint8 of an episode, before the first and after each step, without and with guidance."""
        videos = []
        for guidance_scale, path in ((0.0, pair.unguided), (self._config.guidance_scale, pair.guided)):
            frames: list[np.ndarray] = []

            def add_frame(env: Any, frames: list[np.ndarray] = frames) -> None:
                frames.append(env.envs[pair.episode].render())

            # Prior noise depends on the number of episodes that run in parallel.
            self._roll_out(pair.n_side_by_side, guidance_scale, add_frame)
            videos.append(frames[: len(path.positions)])
        return videos[0], videos[1]

    def trace_flow(self, n_chunks: int) -> tuple[Tensor, Tensor, np.ndarray, np.ndarray | None]:
        """Generates one chunk for each of several episodes and records each step, without and with guidance.

        Args:
            n_chunks: Number of episodes B.

        Returns:
            ``(N + 1, B, T, A)`` chunks without and with guidance [normalised], ``(B, D)`` starts [m], and ``(B, D)`` goals
            [m] or None.
        """
        if self._config.type not in ("pf2mp", "dppf"):
            raise ValueError(
                f"the figure flow shows the steps of a policy of type pf2mp or dppf, got {self._config.type!r}"
            )
        env = self._make_env(n_chunks)
        observation, _ = env.reset(
            seed=[self._seed + i for i in range(n_chunks)],  # type: ignore[arg-type]
            options={NEW_ROLLOUT_OPTION: True},
        )
        env.close()
        env_preprocess, _ = make_env_pre_post_processors(self._env, self._config)
        raw = env_preprocess({**preprocess_observation(observation), "task": [""] * n_chunks})
        batch = self._preprocess(raw)
        shape = (n_chunks, self._config.horizon, self._config.action_feature.shape[0])
        noise = torch.randn(shape, generator=torch.Generator().manual_seed(self._seed))
        traces = []
        for guide in (None, self._policy.guidance.guide(batch, noise.device)):
            trace = _Trace(guide)
            self._policy.reset()
            with self._changed(max_plans=1):  # the steps of one plan, whether or not it would be drawn again
                self._policy.predict_action_chunk(batch, noise=noise, guide=trace)
            traces.append(torch.stack([noise, *trace.chunks]))
        goals = raw[OBS_ENV_STATE].numpy() if OBS_ENV_STATE in raw else None
        return traces[0], traces[1], raw[OBS_STATE].numpy(), goals

    @contextmanager
    def _changed(self, **options: Any) -> Iterator[None]:
        """Other options of the policy in this block."""
        configured = {name: getattr(self._config, name) for name in options}
        vars(self._config).update(options)
        try:
            yield
        finally:
            vars(self._config).update(configured)

    def _make_env(self, n_envs: int) -> gym.vector.VectorEnv:
        (env,) = next(iter(self._env.create_envs(n_envs, use_async_envs=False).values())).values()
        return env

    def _roll_out(
        self, n_episodes: int, guidance_scale: float, on_step: Callable[[Any], None] | None = None
    ) -> tuple[list[Path2D], list[np.ndarray | None]]:
        # Without guidance it is the plain policy, which executes the first plan that it draws.
        max_plans = self._config.max_plans if guidance_scale else 1
        env_processors = make_env_pre_post_processors(self._env, self._config)
        env = self._make_env(n_episodes)
        pens: list[np.ndarray] = []

        def watch(env: Any) -> None:
            if isinstance(self._env, PF2MPHandwritingEnv):
                pens.append(np.array([each.unwrapped.pen[:2] for each in env.envs]))
            if on_step is not None:
                on_step(env)

        try:
            # stderr gets LeRobot's progress bar.
            with (
                self._changed(guidance_scale=guidance_scale, max_plans=max_plans),
                seeded_prior_noise(self._policy, 0),
                redirect_stderr(io.StringIO()),
            ):
                result = rollout(
                    env,
                    self._policy,
                    *env_processors,
                    self._preprocess,
                    self._postprocess,
                    seeds=[self._seed + i for i in range(n_episodes)],
                    return_observations=True,
                    render_callback=watch,
                )
        finally:
            env.close()
        observations = result["observation"]
        lengths = result["done"].int().argmax(dim=1) + 1
        # Joint positions cannot be drawn in a scene; positions of the pen can.
        trajectories = np.stack(pens, axis=1) if pens else observations[OBS_STATE].numpy()
        paths = [
            Path2D(positions[: length + 1], (rewards[:length] < 0).numpy())
            for positions, rewards, length in zip(trajectories, result["reward"], lengths, strict=True)
        ]
        has_goals = OBS_ENV_STATE in observations
        goals = [observations[OBS_ENV_STATE][i, 0].numpy() if has_goals else None for i in range(n_episodes)]
        if isinstance(self._env, PF2MPMetaWorldEnv):  # the object comes first, and is not the goal
            goals = [None if goal is None else goal[3:] for goal in goals]
        return paths, goals


class _Trace:
    """A guide that records every step. It passes the step to another guide, or leaves it unguided."""

    def __init__(self, guide: Any) -> None:
        self.chunks: list[Tensor] = []
        self._guide = guide

    def __call__(self, x_t: Tensor, x_next: Tensor, x_1: Tensor, dt: float) -> Tensor:
        if self._guide is not None:
            x_next = self._guide(x_t, x_next, x_1, dt)
        self.chunks.append(x_next)
        return x_next


def _clarity(pair: PathPair) -> tuple[bool, float]:
    length = np.linalg.norm(np.diff(pair.guided.positions, axis=0), axis=1).sum()
    return bool(pair.unguided.collisions.any() and not pair.guided.collisions.any()), float(length)


def _first_collisions(pair: PathPair) -> tuple[int | None, int | None]:
    """The number of the first step with a collision, without and with guidance; None without a collision."""
    steps = [np.flatnonzero(path.collisions) for path in (pair.unguided, pair.guided)]
    first, second = (int(at[0]) + 1 if at.size else None for at in steps)
    return first, second
