# SPDX-License-Identifier: Apache-2.0
"""The whole pipeline: demonstrations, training, evaluation without and with guidance, table and figure."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

from lerobot_pf2mp.dataset_tools.maze.collect_maze import collect_maze
from lerobot_pf2mp.dataset_tools.maze.maze_dataset import maze_of
from lerobot_pf2mp.envs.configs.maze import PF2MPMazeEnv
from lerobot_pf2mp.envs.tasks import MAZE_STEPS, MAZE_TASKS
from lerobot_pf2mp.figures.policy_figures import GuidedPolicyFigures
from lerobot_pf2mp.policies.pf2mp.configuration_pf2mp import PF2MPConfig
from lerobot_pf2mp.results.rate import Rate
from lerobot_pf2mp.results.rows import NO_GUIDANCE, EpisodeRow, SummaryRow, write_rows
from lerobot_pf2mp.results.summary import summarise

_MODULES = {
    "pf2mp-train": "lerobot_pf2mp.commands.train",
    "lerobot-eval": "lerobot.scripts.lerobot_eval",
}
DEFAULT_GUIDANCE_SCALE = PF2MPConfig.guidance_scale


def run_demo(
    output_dir: Path, *, task: str, n_demonstrations: int, steps: int, n_episodes: int, seed: int
) -> None:
    """Runs all stages that are not done yet and prints the result.

    Args:
        output_dir: Folder of all files that are written.
        task: maze_umaze, maze_medium or maze_large.
        n_demonstrations: Number of demonstrations to collect.
        steps: Training steps.
        n_episodes: Number of evaluation episodes for each policy.
        seed: Seed of demonstrations, training and evaluation.

    Raises:
        ValueError: If an argument breaks its rule, or the folder holds a demo with other options.
        RuntimeError: If a command fails.
    """
    maze_of(task, None)  # raises an error for an unknown task now, not later
    for name, value in (
        ("n_demonstrations", n_demonstrations),
        ("steps", steps),
        ("n_episodes", n_episodes),
    ):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    options = {
        "task": task,
        "n_demonstrations": n_demonstrations,
        "steps": steps,
        "n_episodes": n_episodes,
        "seed": seed,
    }
    _claim(output_dir, options)
    began = time.monotonic()
    data, checkpoint = output_dir / "demonstrations", output_dir / "train/checkpoints/last/pretrained_model"

    _say(1, f"Demonstrations: {n_demonstrations} trajectories of a scripted expert in the MuJoCo maze")
    _collect(task, data, n_demonstrations, seed)

    _say(2, f"Training: a small network, {steps} steps; the potential field is fitted during training")
    _train(task, data, output_dir / "train", steps, seed)

    episodes: list[EpisodeRow] = []
    for stage, (name, guidance_scale) in enumerate(
        (
            ("FMP: guidance off, one plan", 0.0),
            ("PF2MP: the same weights with guidance and checked plans", DEFAULT_GUIDANCE_SCALE),
        ),
        start=3,
    ):
        _say(stage, f"Evaluation of {name}, {n_episodes} episodes")
        folder = output_dir / ("eval_pf2mp" if guidance_scale else "eval_fmp")
        episodes += _evaluate(task, checkpoint, folder, n_episodes, seed, guidance_scale)

    _say(5, "Figure and table")
    _report(task, checkpoint, output_dir, episodes, seed)
    print(f"Time: {(time.monotonic() - began) / 60:.1f} minutes")


def _claim(output_dir: Path, options: dict[str, object]) -> None:
    """Marks the folder as a demo with these options, so that a second call resumes the same one."""
    mark = output_dir / "demo.json"
    if mark.exists():
        found = json.loads(mark.read_text(encoding="utf-8"))
        if found != options:
            raise ValueError(
                f"{output_dir} holds a demo with other options ({found}), got {options}: choose another --output_dir"
            )
    elif output_dir.exists() and any(output_dir.iterdir()):
        raise ValueError(f"--output_dir must be new, empty or a demo's, got {output_dir}")
    else:
        output_dir.mkdir(parents=True, exist_ok=True)
        mark.write_text(json.dumps(options, indent=2), encoding="utf-8")


def _collect(task: str, data: Path, n_demonstrations: int, seed: int) -> None:
    if data.exists():
        print("done already")
        return
    n_written, dropped = collect_maze(
        maze_of(task, None),
        root=data,
        repo_id=f"local/{task}",
        n_episodes=n_demonstrations,
        n_steps=MAZE_STEPS,
        action_noise=0.0,
        seed=seed,
        overwrite=False,
    )
    print(f"{n_written} collision-free trajectories ({dropped.total()} left out)")


def _train(task: str, data: Path, output_dir: Path, steps: int, seed: int) -> None:
    last = output_dir / "checkpoints/last"
    done = (
        json.loads((last / "training_state/training_step.json").read_text())["step"] if last.exists() else 0
    )
    if done >= steps:
        print("done already")
        return
    if done:
        _run(
            "pf2mp-train",
            f"--config_path={last / 'pretrained_model/train_config.json'}",
            "--resume=true",
            equivalent="lerobot-train",
        )
        return
    shutil.rmtree(output_dir, ignore_errors=True)  # a run that was interrupted before its first checkpoint
    _run(
        "pf2mp-train",
        f"--dataset.repo_id=local/{task}",
        f"--dataset.root={data}",
        "--policy.type=pf2mp",
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        f"--policy.horizon={MAZE_STEPS}",
        f"--policy.n_action_steps={MAZE_STEPS}",
        f"--policy.drop_n_last_frames={MAZE_STEPS - 1}",
        "--policy.down_dims=[32,64,128]",
        "--batch_size=64",
        f"--steps={steps}",
        "--save_freq=500",
        "--log_freq=100",
        f"--seed={seed}",
        f"--output_dir={output_dir}",
        equivalent="lerobot-train",
    )


def _env_task(task: str) -> str:
    return {maze: name for name, maze in MAZE_TASKS.items()}[maze_of(task, None)]


def _evaluate(
    task: str, checkpoint: Path, output_dir: Path, n_episodes: int, seed: int, guidance_scale: float
) -> list[EpisodeRow]:
    env_task = _env_task(task)
    if output_dir.exists():
        print("done already")
    else:
        partial = output_dir.with_name(f"{output_dir.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        _run(
            "lerobot-eval",
            f"--policy.path={checkpoint}",
            f"--policy.guidance_scale={guidance_scale:g}",
            *([] if guidance_scale else ["--policy.max_plans=1"]),
            "--env.type=pf2mp_maze",
            f"--env.task={env_task}",
            f"--eval.n_episodes={n_episodes}",
            f"--eval.batch_size={min(n_episodes, 50)}",
            "--eval.use_async_envs=false",
            f"--seed={seed}",
            f"--output_dir={partial}",
            log=output_dir.with_suffix(".log"),
        )
        partial.rename(output_dir)
    metrics = json.loads((output_dir / "eval_info.json").read_text())["per_task"][0]["metrics"]
    return [
        EpisodeRow(
            task=env_task,
            policy="pf2mp" if guidance_scale else "fmp",
            guidance_integrator=PF2MPConfig.guidance_integrator if guidance_scale else NO_GUIDANCE,
            guidance_scale=guidance_scale,
            variant="",
            seed=seed,
            repeat=0,
            episode=number,
            success=success,
            collision=reward < 0,
            plan_in_wall=None,
            min_clearance_m=None,
            path_length_m=None,
            stroke_error_mm=None,
            steps=None,
            chunk_latency_ms=None,
            checkpoint=str(checkpoint),
            commit="",
        )
        for number, (success, reward) in enumerate(
            zip(metrics["successes"], metrics["sum_rewards"], strict=True)
        )
    ]


def _report(task: str, checkpoint: Path, output_dir: Path, episodes: list[EpisodeRow], seed: int) -> None:
    """Draws the figure, unless it is there, and writes and prints the table."""
    figure = output_dir / "overview.png"
    if not figure.exists():
        figures = GuidedPolicyFigures(checkpoint, PF2MPMazeEnv(task=_env_task(task)), seed=seed)
        figures.draw("overview", figure, 1, (), "light")
    results = summarise(episodes)
    table = _table(results)
    (output_dir / "results.md").write_text(table, encoding="utf-8")
    write_rows(output_dir / "results.csv", results, SummaryRow)
    print(f"\n{table}\nFigure: {figure}\nTable: {output_dir / 'results.md'}")


def _run(command: str, *options: str, equivalent: str | None = None, log: Path | None = None) -> None:
    """Prints a command of LeRobot or of this package and runs it in its own process. Its output goes into `log` if given."""
    print(f"$ {command} {shlex.join(options)}")
    if equivalent is not None:
        print(f"  (the same with LeRobot's own loader, slower: {equivalent} with these options)")
    sys.stdout.flush()
    with log.open("wb") if log else nullcontext() as output:
        finished = subprocess.run(
            [sys.executable, "-P", "-m", _MODULES[command], *options],
            check=False,
            stdout=output,
            stderr=output,
        )
    if finished.returncode != 0:
        where = f"see {log}" if log else "its output is above"
        raise RuntimeError(f"{command} failed with exit code {finished.returncode}; {where}")


def _table(results: list[SummaryRow]) -> str:
    lines = ["| policy | collision rate | success rate | episodes |", "|---|---|---|---|"]
    for result in results:
        collision, success = (
            Rate(count or 0, result.n_episodes) for count in (result.collisions, result.successes)
        )
        lines.append(f"| {result.policy} | {collision} | {success} | {result.n_episodes} |")
    return "\n".join(lines) + "\n"


def _say(stage: int, what: str) -> None:
    print(f"\n[{stage}/5] {what}", flush=True)
