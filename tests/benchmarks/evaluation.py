# SPDX-License-Identifier: Apache-2.0
"""How long a benchmark of the paper's size takes: 500 episodes in the large maze, 3 repeats, 4 policies, and why.

The policies are fmp, pf2mp, dp and dppf with the small U-Net. The whole is pf2mp-benchmark as a user calls it, with two
processes of one thread each, start-up included; where the time goes is measured in one process, without it.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

from gymnasium.vector import SyncVectorEnv
from harness import Row, threads
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.processor import DataProcessorPipeline
from lerobot.scripts import lerobot_eval
from maze_policies import train
from stopwatch import Stopwatch

from lerobot_pf2mp import PF2MPMazeEnv
from lerobot_pf2mp.benchmark import evaluation as pf2mp_evaluation
from lerobot_pf2mp.benchmark.episode_recorder import EpisodeRecorder
from lerobot_pf2mp.benchmark.run import run_benchmark
from lerobot_pf2mp.benchmark.spec import NONE, BenchmarkSpec, Guidance
from lerobot_pf2mp.policies.dppf.modeling_dppf import DPPFPolicy
from lerobot_pf2mp.policies.fmp.modeling_fmp import FMPPolicy

N_EPISODES, N_REPEATS = 500, 3
N_PROCESSES = 2
N_WATCHED_EPISODES = 500  # of each policy: a repeat
TARGET_SECONDS = 300.0

# Every function that is timed, and under which name.
_WATCHED = (
    (PF2MPMazeEnv, "create_envs", "making environments"),
    (SyncVectorEnv, "step", "env steps"),
    (SyncVectorEnv, "reset", "env resets"),
    (SyncVectorEnv, "call", "env calls"),
    (EpisodeRecorder, "step", "recording"),
    (EpisodeRecorder, "reset", "recording"),
    (FMPPolicy, "predict_action_chunk", "network and guidance"),
    (DPPFPolicy, "predict_action_chunk", "network and guidance"),
    (FMPPolicy, "select_action", "queues of observations and actions"),
    (DiffusionPolicy, "select_action", "queues of observations and actions"),
    (DataProcessorPipeline, "__call__", "processors"),
    (lerobot_eval, "preprocess_observation", "observations to tensors"),
    (pf2mp_evaluation, "load_policy", "loading"),
    (pf2mp_evaluation, "_measure_latency", "measuring latency"),
    (pf2mp_evaluation, "eval_policy", "the rest of LeRobot's rollout"),
)


def measure() -> Iterator[Row]:
    """The rows of this part."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        policies = {kind: str(folder / kind) for kind in ("pf2mp", "dppf")}
        for kind, path in policies.items():
            train(kind).save(Path(path))
        yield _measure_whole(policies, folder / "whole")
        with threads(1):
            yield from _measure_shares(policies, folder / "shares")


def _measure_whole(policies: dict[str, str], output_dir: Path) -> Row:
    # Without guidance the two are fmp and dp.
    command = [
        str(Path(sys.executable).with_name("pf2mp-benchmark")),
        f"--policies={{{', '.join(f'{name}: {path}' for name, path in policies.items())}}}",
        "--env.type=pf2mp_maze",
        "--guidance=[none, 'proximal:0.8']",
        f"--n_episodes={N_EPISODES}",
        f"--n_repeats={N_REPEATS}",
        f"--n_processes={N_PROCESSES}",
        f"--output_dir={output_dir}",
    ]
    began = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    seconds = time.perf_counter() - began
    case = f"{N_EPISODES} episodes x {N_REPEATS} repeats x 4 policies, {N_PROCESSES} processes"
    return Row("evaluation", case, "pf2mp-benchmark", seconds, "s", target=TARGET_SECONDS)


def _measure_shares(policies: dict[str, str], output_dir: Path) -> Iterator[Row]:
    spec = BenchmarkSpec(
        env=PF2MPMazeEnv(),
        tasks=("MazeLarge-v0",),
        policies=policies,
        guidances=(NONE, Guidance("proximal", 0.8)),
        variants={"": {}},
        n_repeats=1,
        n_episodes=N_WATCHED_EPISODES,
    )
    stopwatch = Stopwatch()
    with ExitStack() as stack:
        for owner, function, name in _WATCHED:
            stack.enter_context(stopwatch.on(owner, function, name))
        stack.enter_context(redirect_stderr(StringIO()))
        stack.enter_context(redirect_stdout(StringIO()))
        began = time.perf_counter()
        run_benchmark(spec, output_dir)
        seconds = time.perf_counter() - began
    case = f"{N_WATCHED_EPISODES} episodes x 4 policies, 1 process"
    yield Row("evaluation", case, "an episode", 1000 * seconds / (4 * N_WATCHED_EPISODES), "ms")
    stopwatch.seconds["everything else"] = seconds - sum(stopwatch.seconds.values())
    for name, value in sorted(stopwatch.seconds.items(), key=lambda item: -item[1]):
        yield Row("evaluation", case, f"share of {name}", 100 * value / seconds, "%")
