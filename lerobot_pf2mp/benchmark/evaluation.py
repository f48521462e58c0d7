# SPDX-License-Identifier: Apache-2.0
"""Evaluates a policy on a benchmark's episodes, one repeat at a time, with LeRobot's own evaluation."""

from __future__ import annotations

import io
import statistics
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from lerobot.envs import make_env_pre_post_processors
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, preprocess_observation
from lerobot.policies import PreTrainedPolicy
from lerobot.scripts.lerobot_eval import eval_policy

from lerobot_pf2mp.benchmark.episode_recorder import EpisodeRecorder
from lerobot_pf2mp.benchmark.prior_noise import seeded_prior_noise
from lerobot_pf2mp.benchmark.spec import BenchmarkSpec, Job
from lerobot_pf2mp.loading import load_policy, loaded_demonstrations
from lerobot_pf2mp.policies.guided.configuration_guided import GuidedConfig
from lerobot_pf2mp.policies.guided.potential_field_step import PotentialFieldProcessorStep
from lerobot_pf2mp.process.worker_pool import worker_pool
from lerobot_pf2mp.results.rows import EpisodeRow

_N_LATENCY_CALLS = 11


def evaluate_all(spec: BenchmarkSpec, jobs: Sequence[Job], n_processes: int) -> Iterator[list[EpisodeRow]]:
    """Evaluates all jobs. Yields the rows of each job, in the order of the jobs.

    Args:
        spec: The benchmark.
        jobs: Its repeats.
        n_processes: Number of parallel processes. With more than one, each uses one thread.
    """
    commit = _commit()
    if n_processes == 1:
        yield from map(_Evaluator(spec, commit), jobs)
        return
    with worker_pool(n_processes, _start_worker, (spec, commit)) as pool:
        yield from pool.map(_work, jobs)


def _commit() -> str:
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short=10", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


class _Evaluator:
    """Evaluates jobs one after the other. It keeps the last policy and environment for the next job."""

    def __init__(self, spec: BenchmarkSpec, commit: str) -> None:
        self._spec = spec
        self._commit = commit
        self._load = lru_cache(maxsize=1)(self._load_policy)
        self._make_env = lru_cache(maxsize=1)(self._make_vector_env)

    def __call__(self, job: Job) -> list[EpisodeRow]:
        """Evaluates a job and returns the rows of its episodes."""
        spec = self._spec
        policy, preprocessor, postprocessor, max_plans = self._load(job.checkpoint, job.variant)
        env_config, env = self._make_env(job.task)
        measures_plans = False
        if isinstance(policy.config, GuidedConfig):
            self._set_options(policy.config, job, max_plans)
            measures_plans = _can_check_plans(policy.config, preprocessor, max_plans)
        env_preprocessor, env_postprocessor = make_env_pre_post_processors(env_config, policy.config)
        latency = _measure_latency(env, policy, env_preprocessor, preprocessor, spec.episode_seed)
        env.watch(policy)
        # stderr gets LeRobot's own progress bars.
        with (
            seeded_prior_noise(policy, job.repeat),
            _measured_plans(policy, measures_plans),
            redirect_stderr(io.StringIO()),
        ):
            outcomes = eval_policy(
                env,
                policy,
                env_preprocessor,
                env_postprocessor,
                preprocessor,
                postprocessor,
                spec.n_episodes,
                start_seed=spec.episode_seed,
            )["per_episode"]
        episodes = env.take_episodes(spec.n_episodes)
        return [
            EpisodeRow(
                task=job.task,
                policy=job.policy,
                guidance_integrator=job.guidance.integrator,
                guidance_scale=job.guidance.scale,
                variant=job.variant,
                seed=job.seed,
                repeat=job.repeat,
                episode=number,
                success=bool(outcome["success"]),
                collision=episode.collision,
                plan_in_wall=episode.plan_in_wall,
                min_clearance_m=_rounded(episode.min_clearance),
                path_length_m=_rounded(episode.path_length),
                stroke_error_mm=_rounded(episode.stroke_error, 1000),
                steps=episode.steps,
                chunk_latency_ms=latency,
                checkpoint=job.checkpoint,
                commit=self._commit,
                plans_drawn=episode.plans_drawn,
                n_plans=episode.n_plans,
                plan_flagged=episode.plan_flagged,
                obstacle_collision=episode.obstacle_collision,
            )
            for number, (outcome, episode) in enumerate(zip(outcomes, episodes, strict=True))
        ]

    def _load_policy(self, checkpoint: str, variant: str) -> tuple[Any, Any, Any, int]:
        """The policy, its processors, and its own ``max_plans``, which jobs may change in its configuration."""
        policy, *processors = load_policy(
            checkpoint, device=self._spec.device, **self._spec.variants[variant]
        )
        return policy, *processors, getattr(policy.config, "max_plans", 1)

    def _set_options(self, config: Any, job: Job, max_plans: int) -> None:
        config.guidance_scale = job.guidance.scale
        if job.guidance.scale:
            config.guidance_integrator = job.guidance.integrator
        # Without guidance it is the plain policy, which executes the first plan that it draws.
        is_plain = job.guidance.scale == 0 and "max_plans" not in self._spec.variants[job.variant]
        config.max_plans = 1 if is_plain else max_plans

    def _make_vector_env(self, task: str) -> tuple[EnvConfig, EpisodeRecorder]:
        env_config = replace(self._spec.env, task=task)
        n_envs = min(self._spec.batch_size, self._spec.n_episodes)
        (env,) = next(iter(env_config.create_envs(n_envs, use_async_envs=False).values())).values()
        return env_config, EpisodeRecorder(env)


_worker: _Evaluator | None = None


def _start_worker(spec: BenchmarkSpec, commit: str) -> None:
    global _worker
    torch.set_num_threads(1)
    _worker = _Evaluator(spec, commit)


def _work(job: Job) -> list[EpisodeRow]:
    assert _worker is not None  # set when the process started
    return _worker(job)


def _can_check_plans(config: Any, preprocessor: Any, max_plans: int) -> bool:
    """Whether a guided policy has what its plans are checked with.

    Raises:
        ValueError: If it has a field that is not calibrated for plans, and is to draw plans again.
    """
    fields = [step for step in preprocessor.steps if isinstance(step, PotentialFieldProcessorStep)]
    if not any(len(step.demonstrations) for step in fields):
        return False
    try:
        loaded_demonstrations(preprocessor).plan_threshold(
            config.field_settings, config.n_action_steps, config.false_alarm_rate
        )
    except ValueError:
        if max_plans > 1:
            raise
        return False
    return True


@contextmanager
def _measured_plans(policy: Any, is_on: bool) -> Iterator[None]:
    """Makes a guided policy check every plan, also where it draws no other one, so that flagged plans are counted."""
    if not is_on:
        yield
        return
    policy.guidance.measures_plans = True
    try:
        yield
    finally:
        policy.guidance.measures_plans = False


def _rounded(value: float | None, factor: float = 1) -> float | None:
    return None if value is None else round(factor * value, 6)


def _measure_latency(
    env: EpisodeRecorder,
    policy: PreTrainedPolicy,
    env_preprocessor: Any,
    preprocessor: Any,
    episode_seed: int,
) -> float:
    """The median time of a call that generates a new chunk for one robot [ms].

    It is what a user waits for: also for the check of the plan and for other plans, if the policy itself does that. A
    check that only the benchmark asks for is left out, because it is switched on later.
    """
    policy.eval()
    observation, _ = env.reset(
        seed=[episode_seed + i for i in range(env.num_envs)], options={NEW_ROLLOUT_OPTION: True}
    )
    observation = preprocess_observation(_of_first(observation))
    observation = preprocessor(env_preprocessor({**observation, "task": [""]}))
    times = []
    for _ in range(_N_LATENCY_CALLS):
        policy.reset()
        _wait_for(policy)
        began = time.perf_counter()
        with torch.inference_mode():
            policy.select_action(dict(observation))
        _wait_for(policy)
        times.append(time.perf_counter() - began)
    return round(1000 * statistics.median(times[1:]), 3)  # the first call is a warm-up


def _wait_for(policy: PreTrainedPolicy) -> None:
    if next(policy.parameters()).is_cuda:
        torch.cuda.synchronize()


def _of_first(observation: dict[str, Any]) -> dict[str, Any]:
    """The observation of the first of several environments; cameras are dictionaries of images."""
    return {
        key: _of_first(value) if isinstance(value, dict) else value[:1] for key, value in observation.items()
    }
