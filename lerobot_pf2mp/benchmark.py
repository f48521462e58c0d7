# SPDX-License-Identifier: Apache-2.0
"""Compares policies on the same episodes: tasks x policies x guidance x training seeds x repeats, one row an episode.

Every policy gets the same start-goal pairs and, in each repeat, the same prior noise, so that policies can be compared
pair by pair. Evaluation is LeRobot's own, on vectorised environments.
"""

from __future__ import annotations

import csv
import io
import json
import os
import platform
import statistics
import subprocess
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from lerobot.envs import make_env_pre_post_processors
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, preprocess_observation
from lerobot.policies import PreTrainedPolicy
from lerobot.scripts.lerobot_eval import eval_policy
from tqdm import tqdm

from lerobot_pf2mp.episode_recorder import EpisodeRecorder
from lerobot_pf2mp.guidance import GUIDANCE_INTEGRATORS
from lerobot_pf2mp.loading import load_config, load_policy
from lerobot_pf2mp.policies.guided.configuration_guided import GuidedConfig
from lerobot_pf2mp.prior_noise import seeded_prior_noise
from lerobot_pf2mp.results import (
    NO_GUIDANCE,
    EpisodeRow,
    SummaryRow,
    format_row,
    group_cells,
    read_rows,
    summarise,
    write_rows,
)
from lerobot_pf2mp.tables import make_latex, make_markdown
from lerobot_pf2mp.worker_pool import worker_pool
from lerobot_pf2mp.written_beside import file_written_beside

# What a guided policy is called when guidance is off.
UNGUIDED_NAMES = {"pf2mp": "fmp", "dppf": "dp"}

_N_LATENCY_CALLS = 11


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
    """What to compare.

    Args:
        env: The environments' configuration.
        tasks: Its tasks.
        policies: Checkpoints (``pretrained_model`` folders or repositories on the Hub) by name. ``{task}`` and ``{seed}``
            in a path stand for the task and the training seed. Policies of any type can be compared.
        guidances: Kinds of guidance for policies that have one. ``none`` is their unguided twin.
        variants: Changes to the policies' configuration by name; the name "" with no changes is the checkpoint as it is.
        seeds: Training seeds.
        n_repeats: Repeats with other prior noise.
        n_episodes: Start-goal pairs, the same for all.
        episode_seed: Seed of the first pair; pair i has `episode_seed` + i.
        batch_size: Environments that run side by side.
        device: Where the policies run.

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
class _Job:
    """One repeat of one policy with one kind of guidance: the unit that is done or not done."""

    task: str
    policy: str
    checkpoint: str
    guidance: Guidance
    variant: str
    seed: int
    repeat: int


def run_benchmark(spec: BenchmarkSpec, output_dir: Path, *, n_processes: int = 1) -> list[SummaryRow]:
    """Evaluates all policies and writes ``episodes.csv``, ``summary.csv``, ``table.md``, ``table.tex`` and ``run.json``.

    A benchmark that was interrupted goes on where it was; more policies, guidance, variants, seeds or repeats are added to
    those already there.

    Args:
        spec: What to compare.
        output_dir: Where results are written.
        n_processes: Processes side by side. With more than one, each uses one thread.

    Returns:
        One row for each policy, kind of guidance and repeat.

    Raises:
        ValueError: If `output_dir` holds a benchmark with other episodes, or of other policies with the same names.
        FileNotFoundError: If a checkpoint does not exist.
    """
    if n_processes < 1:
        raise ValueError(f"n_processes must be at least 1, got {n_processes}")
    jobs = _make_jobs(spec)
    output_dir.mkdir(parents=True, exist_ok=True)
    episodes = output_dir / "episodes.csv"
    rows = read_rows(episodes, EpisodeRow) if episodes.exists() else []
    _refuse_other_checkpoints(rows, jobs, output_dir)
    _claim(output_dir, spec)
    # Repeats that a kill has cut short are made anew.
    counts = Counter(map(_identify, rows))
    done = {key for key, count in counts.items() if count == spec.n_episodes}
    write_rows(episodes, [row for row in rows if _identify(row) in done], EpisodeRow)
    missing = [job for job in jobs if _identify(job) not in done]
    with (
        episodes.open("a", newline="", encoding="utf-8") as file,
        tqdm(total=len(jobs), initial=len(jobs) - len(missing), desc="Benchmark", unit="repeat") as bar,
    ):
        for rows in _evaluate_all(spec, missing, n_processes):
            csv.writer(file, lineterminator="\n").writerows(map(format_row, rows))
            file.flush()
            bar.update()
    summary = summarise(read_rows(episodes, EpisodeRow))
    write_rows(output_dir / "summary.csv", summary, SummaryRow)
    cells = group_cells(summary)
    for name, make_table in (("table.md", make_markdown), ("table.tex", make_latex)):
        with file_written_beside(output_dir / name) as partial:
            partial.write_text(make_table(cells), encoding="utf-8")
    return summary


def _make_jobs(spec: BenchmarkSpec) -> list[_Job]:
    jobs = []
    for task in spec.tasks:
        replace(spec.env, task=task)  # an unknown task is an error now rather than in the middle
        for name, template in spec.policies.items():
            for seed in spec.seeds:
                checkpoint = template.replace("{task}", task).replace("{seed}", str(seed))
                # Options that do not exist are an error now rather than in the middle.
                configs = [load_config(checkpoint, **options) for options in spec.variants.values()]
                is_guided = isinstance(configs[0], GuidedConfig)
                guidances = spec.guidances if is_guided else (NONE,)
                jobs += [
                    _Job(
                        task=task,
                        policy=name
                        if guidance.scale or not is_guided
                        else UNGUIDED_NAMES.get(name, f"{name} unguided"),
                        checkpoint=checkpoint,
                        guidance=guidance,
                        variant=variant,
                        seed=seed,
                        repeat=repeat,
                    )
                    for variant in spec.variants
                    for guidance in guidances
                    for repeat in range(spec.n_repeats)
                ]
    names = Counter(replace(job, checkpoint="") for job in jobs)
    for job, count in names.items():
        if count > 1:
            raise ValueError(
                f"every policy must have a name of its own, got {job.policy!r} twice (guidance {job.guidance.integrator})"
            )
    return jobs


def _identify(row: _Job | EpisodeRow) -> tuple[object, ...]:
    if isinstance(row, _Job):
        guidance = row.guidance.integrator, row.guidance.scale
    else:
        guidance = row.guidance_integrator, row.guidance_scale
    return row.task, row.policy, row.checkpoint, *guidance, row.variant, row.seed, row.repeat


def _refuse_other_checkpoints(rows: Sequence[EpisodeRow], jobs: Sequence[_Job], output_dir: Path) -> None:
    """Rows of two checkpoints under one name would be counted together."""
    found = {(row.task, row.policy, row.seed): row.checkpoint for row in rows}
    for job in jobs:
        checkpoint = found.get((job.task, job.policy, job.seed), job.checkpoint)
        if checkpoint != job.checkpoint:
            raise ValueError(
                f"{output_dir} holds results of {job.policy!r} from {checkpoint}, got {job.checkpoint}: choose another "
                "name or another --output_dir"
            )


def _claim(output_dir: Path, spec: BenchmarkSpec) -> None:
    """Marks the folder as a benchmark over these episodes, so that a later call can only go on with the same ones."""
    mark = output_dir / "run.json"
    episodes = {
        "env": {
            "type": spec.env.type,
            **{k: v for k, v in asdict(spec.env).items() if not k.startswith("features")},
        },
        **{name: getattr(spec, name) for name in ("n_episodes", "episode_seed", "batch_size", "device")},
    }
    episodes["env"].pop("task")
    variants = spec.variants
    if mark.exists():
        found = json.loads(mark.read_text(encoding="utf-8"))
        if found["episodes"] != json.loads(json.dumps(episodes)):
            raise ValueError(
                f"{output_dir} holds a benchmark over other episodes ({found['episodes']}), got {episodes}: choose another "
                "--output_dir"
            )
        for name, changes in json.loads(json.dumps(variants)).items():
            if found["variants"].get(name, changes) != changes:
                raise ValueError(
                    f"{output_dir} holds results of a variant {name!r} with {found['variants'][name]}, got {changes}: "
                    "choose another name or another --output_dir"
                )
        variants = {**found["variants"], **variants}
    made_with = {
        name: version(name) for name in ("lerobot", "torch", "mujoco", "gymnasium-robotics", "diffusers")
    }
    content = {
        "episodes": episodes,
        "variants": variants,
        "made_with": {
            **made_with,
            "python": platform.python_version(),
            "machine": _describe_machine(spec.device),
        },
    }
    with file_written_beside(mark) as partial:
        partial.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _describe_machine(device: str) -> str:
    cpu = f"{platform.machine()}, {os.cpu_count()} cores"
    return f"{cpu}, {torch.cuda.get_device_name(device)}" if device.startswith("cuda") else cpu


def _evaluate_all(spec: BenchmarkSpec, jobs: Sequence[_Job], n_processes: int) -> Iterator[list[EpisodeRow]]:
    """The rows of each job, in the jobs' order."""
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
    """Evaluates jobs one after the other, keeping the last policy and environment for the next one."""

    def __init__(self, spec: BenchmarkSpec, commit: str) -> None:
        self._spec = spec
        self._commit = commit
        self._load = lru_cache(maxsize=1)(self._load_policy)
        self._make_env = lru_cache(maxsize=1)(self._make_vector_env)

    def __call__(self, job: _Job) -> list[EpisodeRow]:
        """The rows of a job's episodes."""
        spec = self._spec
        policy, preprocessor, postprocessor = self._load(job.checkpoint, job.variant)
        env_config, env = self._make_env(job.task)
        if isinstance(policy.config, GuidedConfig):
            policy.config.guidance_scale = job.guidance.scale
            if job.guidance.scale:
                policy.config.guidance_integrator = job.guidance.integrator
        env_preprocessor, env_postprocessor = make_env_pre_post_processors(env_config, policy.config)
        latency = _measure_latency(env, policy, env_preprocessor, preprocessor, spec.episode_seed)
        with (
            seeded_prior_noise(policy, job.repeat),
            redirect_stderr(io.StringIO()),
        ):  # LeRobot's own progress bars
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
                steps=episode.steps,
                chunk_latency_ms=latency,
                checkpoint=job.checkpoint,
                commit=self._commit,
            )
            for number, (outcome, episode) in enumerate(zip(outcomes, episodes, strict=True))
        ]

    def _load_policy(self, checkpoint: str, variant: str) -> tuple[Any, Any, Any]:
        return load_policy(checkpoint, device=self._spec.device, **self._spec.variants[variant])

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


def _work(job: _Job) -> list[EpisodeRow]:
    assert _worker is not None  # set when the process started
    return _worker(job)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 6)


def _measure_latency(
    env: EpisodeRecorder,
    policy: PreTrainedPolicy,
    env_preprocessor: Any,
    preprocessor: Any,
    episode_seed: int,
) -> float:
    """Median time of a call that plans a new chunk for one robot [ms]."""
    policy.eval()
    observation, _ = env.reset(
        seed=[episode_seed + i for i in range(env.num_envs)], options={NEW_ROLLOUT_OPTION: True}
    )
    observation = preprocess_observation({key: value[:1] for key, value in observation.items()})
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
    return round(1000 * statistics.median(times[1:]), 3)  # the first one also warms up


def _wait_for(policy: PreTrainedPolicy) -> None:
    if next(policy.parameters()).is_cuda:
        torch.cuda.synchronize()
