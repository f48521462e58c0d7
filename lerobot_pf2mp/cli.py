# SPDX-License-Identifier: Apache-2.0
"""The commands: each parses its options, calls one function and says in one line what came out."""

from __future__ import annotations

import logging
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import draccus
from lerobot.envs.configs import EnvConfig

from lerobot_pf2mp.envs.configs import PF2MPMazeEnv
from lerobot_pf2mp.errors import INTERRUPTED

if TYPE_CHECKING:
    from lerobot_pf2mp.benchmark import BenchmarkSpec


@dataclass
class SceneConfig:
    """Where things are on Fetch's table; what is not given is as in the task's environment."""

    # x, y of the wall's centre [m]; it stands on the table.
    wall_position: tuple[float, float] | None = None
    # The wall's sides [m].
    wall_size: tuple[float, float, float] | None = None
    # Two opposite corners x, y, z of where the gripper starts [m].
    start_range: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    # The same of the goal [m]; for fetch_push x and y only.
    goal_range: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    # The same of the block, x and y [m].
    block_range: tuple[tuple[float, ...], tuple[float, ...]] | None = None


@dataclass
class CollectConfig:
    """Makes demonstrations in a simulated environment and writes them as a LeRobotDataset.

    Examples:
        pf2mp-collect --task=maze_large --root=data/maze_large
        pf2mp-collect --task=maze_medium --n_episodes=500 --action_noise=0.5 --seed=1 --root=data/noisy
        pf2mp-collect --maze_map=1111111/1000001/1011101/1000001/1111111 --root=data/ring
        pf2mp-collect --task=fetch_push --style=hug --n_processes=2 --root=data/fetch_push_hug
        pf2mp-collect --task=fetch_reach --scene.wall_size=[0.3,0.04,0.25] --root=data/high_wall
        pf2mp-collect --task=fetch_reach --expert=outputs/expert_reach --root=data/fetch_reach_ppo
    """

    # What to demonstrate: maze_umaze, maze_medium, maze_large, fetch_reach or fetch_push.
    task: str = "maze_large"
    # Folder of the dataset; by default where LeRobot keeps the datasets of your Hub account.
    root: Path | None = None
    # Name of the dataset, user/name; by default local/TASK.
    repo_id: str | None = None
    # Demonstrations to write; by default 4000 for a maze, 1000 for Fetch.
    n_episodes: int | None = None
    # Steps that each demonstration is resampled to; by default 80 for a maze, 48 for Fetch.
    n_steps: int | None = None
    # Mazes: standard deviation of the noise on the expert's force, of which 1 is the largest (100 N).
    action_noise: float = 0.0
    # Mazes: a map of your own instead of the task's: rows of 0 (free) and 1 (wall) separated by "/".
    maze_map: str | None = None
    # Fetch: scripted, or the folder of an expert trained by pf2mp-train-expert, in the same scene.
    expert: str = "scripted"
    # Fetch: how near the scripted expert comes to the wall: clear keeps away, hug passes close by.
    style: str = "clear"
    # Fetch: the wall, and where the gripper, the goal and the block are placed.
    scene: SceneConfig = field(default_factory=SceneConfig)
    # Fetch: width of a camera's pictures [pixels], which are recorded as a video; none by default.
    picture_width: int | None = None
    # Fetch: processes side by side.
    n_processes: int = 1
    # Seed of everything random.
    seed: int = 0
    # Whether to replace a dataset that is already there.
    overwrite: bool = False


@dataclass
class TrainExpertConfig:
    """Trains an expert for Fetch by reinforcement learning, for pf2mp-collect --expert=FOLDER.

    Needs: pip install "lerobot_policy_pf2mp[experts]". Called again, it goes on where it was interrupted, or up to a larger
    number of steps. The wall blocks the robot; touching it costs nothing unless asked for.

    Examples:
        pf2mp-train-expert --task=fetch_reach --output_dir=outputs/expert_reach
        pf2mp-train-expert --task=fetch_push --algo=sac_her --total_steps=1000000 --device=cuda \
--output_dir=outputs/expert_push
        pf2mp-train-expert --task=fetch_reach --collision_penalty=0.5 --options='{net_arch: [128, 128]}' \
--output_dir=outputs/careful
    """

    # What to learn: fetch_reach or fetch_push.
    task: str = "fetch_reach"
    # ppo, or sac_her (SAC with hindsight experience replay); by default ppo for fetch_reach, sac_her for fetch_push.
    algo: str | None = None
    # Environment steps of 0.04 s in all, rounded up to whole rollouts (ppo: 2048 steps).
    total_steps: int = 1_000_000
    # Folder of the expert.
    output_dir: Path | None = None
    # dense: minus the distance to the goal [m]; sparse: 0 within 0.05 m of it, else -1. By default dense for ppo, sparse
    # for sac_her.
    reward: str | None = None
    # Subtracted from the reward of each step that touches the wall.
    collision_penalty: float = 0.0
    # The wall, and where the gripper, the goal and the block are placed.
    scene: SceneConfig = field(default_factory=SceneConfig)
    # Changes to the algorithm's hyper-parameters, under the names of Stable-Baselines3.
    options: dict[str, Any] = field(default_factory=dict)
    # Seed of everything random.
    seed: int = 0
    # Environment steps between checkpoints.
    save_freq: int = 50_000
    # Where the networks are trained, cpu or cuda.
    device: str = "cpu"


@dataclass
class SourceConfig:
    """Where recorded demonstrations come from."""

    # Layout of the recording: d4rl (maze2d, one HDF5 file), minari (pointmaze, a folder) or fetch (gymnasium-robotics'
    # FetchReach or FetchPush: an npz file, or the folder of a Minari dataset).
    type: str = "d4rl"
    # The file or folder.
    path: Path | None = None


@dataclass
class ConvertConfig:
    """Turns recorded demonstrations into a LeRobotDataset.

    Examples:
        pf2mp-convert --source.type=d4rl --source.path=maze2d-large-sparse-v1.hdf5 --task=maze_large --root=data/d4rl
        pf2mp-convert --source.type=minari --source.path=~/.minari/datasets/D4RL/pointmaze/medium-v2 \
--task=maze_medium --root=data/minari
        pf2mp-convert --source.type=fetch --source.path=reach.npz --task=fetch_reach --root=data/reach
        pf2mp-convert --source.type=fetch --source.path=~/.minari/datasets/fetch/push-v0 --task=fetch_push \
--scene.wall_position=[1.30,0.80] --root=data/push

    npz files of Fetch hold, without pickles, observation (E, T+1, 10 for Reach or 25 for Push) and desired_goal (E, T+1 or
    T, 3) of E episodes. Or they hold the rows of all episodes, observation (N, 10 or 25) and desired_goal (N, 3), with
    episode_ends (E), the row after each episode's last, or terminals and timeouts (N), true in each episode's last row. An
    observation begins with the gripper's position, for Push followed by the block's [m]; an episode's last desired goal is
    its goal. Episodes that do not end within 0.05 m of it are left out.
    """

    # The recording.
    source: SourceConfig = field(default_factory=SourceConfig)
    # What was recorded: maze_umaze, maze_medium, maze_large, fetch_reach or fetch_push. Episodes that touch its walls are
    # left out.
    task: str = "maze_large"
    # Folder of the dataset; by default where LeRobot keeps the datasets of your Hub account.
    root: Path | None = None
    # Name of the dataset, user/name; by default local/TASK.
    repo_id: str | None = None
    # Most episodes to write; all by default.
    n_episodes: int | None = None
    # Steps that each episode is resampled to; by default 80 for a maze, 48 for Fetch.
    n_steps: int | None = None
    # Mazes: a map of your own instead of the task's: rows of 0 (free) and 1 (wall) separated by "/".
    maze_map: str | None = None
    # Fetch: where the wall is; the ranges only have to leave places clear of it.
    scene: SceneConfig = field(default_factory=SceneConfig)
    # Whether to replace a dataset that is already there.
    overwrite: bool = False


@dataclass
class FitFieldPolicyConfig:
    """Which policy gets a field, and which of its options change; unset ones keep the checkpoint's or default value."""

    # The checkpoint's pretrained_model folder, or a repository user/name on the Hub.
    path: str | None = None
    # Branch, tag or commit on the Hub.
    revision: str | None = None
    # lambda, the strength of the guidance.
    guidance_scale: float | None = None
    # proximal or euler.
    guidance_integrator: str | None = None
    # Demonstrated actions kept as anchors of the field.
    n_field_points: int | None = None
    # Action dimensions that the field covers; by default all.
    field_action_dims: tuple[int, ...] | None = None
    # Kernel bandwidth [normalised action units], or likelihood, scott or silverman.
    field_bandwidth: float | str | None = None
    # Quantile of the anchors' own densities above which an action counts as safe.
    field_threshold_quantile: float | None = None
    # Weight of the distance to the safe set, at most 0.
    field_alpha: float | None = None


@dataclass
class FitFieldDatasetConfig:
    """Whose actions the field is fitted to."""

    # Name of the LeRobotDataset, user/name.
    repo_id: str | None = None
    # Its folder; by default LeRobot's cache, filled from the Hub.
    root: Path | None = None
    # Branch, tag or commit on the Hub.
    revision: str | None = None
    # Episodes to use; all by default.
    episodes: list[int] | None = None


@dataclass
class FitFieldConfig:
    """Gives a trained policy a potential field without retraining: diffusion becomes dppf, fmp becomes pf2mp.

    A pf2mp or dppf policy gets a new field. The new checkpoint works with lerobot-eval, lerobot-train and lerobot-rollout.

    Examples:
        pf2mp-fit-field --policy.path=outputs/diffusion/checkpoints/last/pretrained_model \
--dataset.repo_id=you/your_dataset --output_dir=outputs/dppf
        pf2mp-fit-field --policy.path=you/your_fmp --policy.n_field_points=10000 --dataset.repo_id=you/your_dataset \
--output_dir=outputs/pf2mp
    """

    # The policy.
    policy: FitFieldPolicyConfig = field(default_factory=FitFieldPolicyConfig)
    # The demonstrations.
    dataset: FitFieldDatasetConfig = field(default_factory=FitFieldDatasetConfig)
    # Folder of the new checkpoint.
    output_dir: Path | None = None
    # Whether to replace a checkpoint that is already there.
    overwrite: bool = False


@dataclass
class DemoConfig:
    """Runs the main job: demonstrations, training, evaluation with guidance off and on, a table and a figure.

    Stages that are done are skipped, so that the command can be interrupted and called again.

    Examples:
        pf2mp-demo --output_dir=demo
        pf2mp-demo --output_dir=demo_medium --task=maze_medium --steps=1000
    """

    # Folder of everything the demo writes.
    output_dir: Path = Path("demo")
    # maze_umaze, maze_medium or maze_large.
    task: str = "maze_large"
    # Demonstrations.
    n_demonstrations: int = 4000
    # Training steps of 64 trajectories.
    steps: int = 2000
    # Evaluation episodes for each policy.
    n_episodes: int = 500
    # Seed of demonstrations, training and evaluation.
    seed: int = 0


@dataclass
class BenchmarkConfig:
    """Compares policies on the same start-goal pairs and the same prior noise; writes CSV files and tables.

    Called again, it goes on where it was interrupted, or adds what is new. Checkpoints are named by the training seed and
    task: {seed} and {task} in a path are replaced. Policies without guidance, also those of LeRobot itself, are evaluated
    once for each seed and repeat; pf2mp and dppf policies once more for each kind of guidance.

    Examples:
        pf2mp-benchmark --policies='{pf2mp: outputs/maze_large/checkpoints/last/pretrained_model}' \
--output_dir=outputs/benchmark
        pf2mp-benchmark --config_path=eval_configs/benchmark_maze.yaml --n_processes=2
        pf2mp-benchmark --policies='{pf2mp: you/your_pf2mp, act: you/your_act}' \
--guidance='[none, "proximal:0.08,0.8,8"]' --n_episodes=100 --output_dir=outputs/comparison
    """

    # Checkpoints by name: pretrained_model folders or repositories on the Hub, of any LeRobot policy.
    policies: dict[str, str] = field(default_factory=dict)
    # The environment and how it is run.
    env: EnvConfig = field(default_factory=PF2MPMazeEnv)
    # Its tasks; by default the environment's one.
    tasks: list[str] = field(default_factory=list)
    # Kinds of guidance: none, or INTEGRATOR:LAMBDA,LAMBDA,...
    guidance: list[str] = field(default_factory=lambda: ["none", "proximal:0.8"])
    # Changes to the policies' options by name, for example {wide: {field_bandwidth: 0.1}}.
    variants: dict[str, dict[str, Any]] = field(default_factory=lambda: {"": {}})
    # Training seeds, for {seed} in the checkpoints' paths.
    seeds: list[int] = field(default_factory=lambda: [0])
    # Repeats with other prior noise.
    n_repeats: int = 3
    # Start-goal pairs, the same for every policy and every repeat.
    n_episodes: int = 500
    # Seed of the first pair; pair i has this seed + i.
    episode_seed: int = 100000
    # Environments that run side by side.
    batch_size: int = 50
    # Where the policies run.
    device: str = "cpu"
    # Processes side by side, with one thread each; 1 uses all threads in one process.
    n_processes: int = 1
    # Folder of episodes.csv, summary.csv, table.md, table.tex and run.json.
    output_dir: Path = Path("outputs/benchmark")


@dataclass
class PlotConfig:
    """Draws a figure from benchmark results or from a checkpoint.

    lambda: collision and success rate against lambda, from --results. density, arrows: the potential field of
    --checkpoint. trajectories: episodes without and with guidance, from the same start and noise. overview: all of these
    for a maze. flow: an animation (GIF) of chunks that move from noise to paths. video: one episode without and with
    guidance, side by side (MP4).

    Examples:
        pf2mp-plot --figure=lambda --results=[results/maze_lambda] --task=MazeLarge-v0 --output=lambda.png
        pf2mp-plot --figure=density --checkpoint=outputs/maze_large/checkpoints/last/pretrained_model \
--env.type=pf2mp_maze --env.task=MazeLarge-v0 --background=dark --output=density.png
        pf2mp-plot --figure=flow --checkpoint=you/your_pf2mp --options='{num_inference_steps: 20}' --output=flow.gif
    """

    # lambda, density, arrows, trajectories, overview, flow or video.
    figure: str = "overview"
    # The file to write: PNG, GIF for flow, MP4 for video.
    output: Path | None = None
    # For lambda: folders written by pf2mp-benchmark, or their summary.csv.
    results: list[Path] = field(default_factory=list)
    # For lambda: which task, if the results are of several.
    task: str | None = None
    # For the others: the pretrained_model folder of a pf2mp or dppf policy, or its repository on the Hub.
    checkpoint: str | None = None
    # The environment.
    env: EnvConfig = field(default_factory=PF2MPMazeEnv)
    # Changes to the policy's options, for example {guidance_scale: 0.4}.
    options: dict[str, Any] = field(default_factory=dict)
    # Episodes to draw; by default those that show the difference best.
    episodes: list[int] = field(default_factory=list)
    # How many episodes to draw if none are named; for flow, how many chunks.
    n_episodes: int = 6
    # Seed of the first episode; episode i has this seed + i.
    seed: int = 100000
    # light or dark.
    background: str = "light"


def collect() -> None:
    """The command pf2mp-collect."""
    _run(CollectConfig, _collect)


def train_expert() -> None:
    """The command pf2mp-train-expert."""
    _run(TrainExpertConfig, _train_expert)


def convert() -> None:
    """The command pf2mp-convert."""
    _run(ConvertConfig, _convert)


def fit_field() -> None:
    """The command pf2mp-fit-field."""
    _run(FitFieldConfig, _fit_field)


def demo() -> None:
    """The command pf2mp-demo."""
    _run(DemoConfig, _demo)


def benchmark() -> None:
    """The command pf2mp-benchmark."""
    _run(BenchmarkConfig, _benchmark)


def plot() -> None:
    """The command pf2mp-plot."""
    _run(PlotConfig, _plot)


def train() -> None:
    """The command pf2mp-train: lerobot-train with low-dimensional datasets kept in memory."""
    from lerobot_pf2mp.train import main

    main()


def _collect(config: CollectConfig) -> None:
    from lerobot_pf2mp.dataset_tools.fetch_dataset import FETCH_OF_TASK
    from lerobot_pf2mp.dataset_tools.maze_dataset import MAZE_OF_TASK

    if config.maze_map is not None or config.task in MAZE_OF_TASK:
        _collect_maze(config)
    elif config.task in FETCH_OF_TASK:
        _collect_fetch(config, FETCH_OF_TASK[config.task])
    else:
        raise ValueError(f"task must be one of {[*MAZE_OF_TASK, *FETCH_OF_TASK]}, got {config.task!r}")


def _collect_maze(config: CollectConfig) -> None:
    from lerobot_pf2mp.dataset_tools.collect_maze import collect_maze
    from lerobot_pf2mp.dataset_tools.maze_dataset import maze_of

    if config.expert != "scripted":
        raise ValueError(f"expert must be scripted for a maze, got {config.expert!r}")
    repo_id, root = _dataset_place(config)
    n_steps = 80 if config.n_steps is None else config.n_steps
    n_written, dropped = collect_maze(
        maze_of(config.task, config.maze_map),
        root=root,
        repo_id=repo_id,
        n_episodes=4000 if config.n_episodes is None else config.n_episodes,
        n_steps=n_steps,
        action_noise=config.action_noise,
        seed=config.seed,
        overwrite=config.overwrite,
    )
    _report(n_written, n_steps, dropped, root)


def _collect_fetch(config: CollectConfig, task: str) -> None:
    from lerobot_pf2mp.dataset_tools.collect_fetch import collect_fetch

    repo_id, root = _dataset_place(config)
    n_steps = 48 if config.n_steps is None else config.n_steps
    n_written, dropped = collect_fetch(
        task,
        root=root,
        repo_id=repo_id,
        n_episodes=1000 if config.n_episodes is None else config.n_episodes,
        n_steps=n_steps,
        style=config.style,
        picture_width=config.picture_width,
        scene_changes=asdict(config.scene),
        seed=config.seed,
        n_processes=config.n_processes,
        overwrite=config.overwrite,
        expert=None if config.expert == "scripted" else Path(config.expert).expanduser(),
    )
    _report(n_written, n_steps, dropped, root)


def _train_expert(config: TrainExpertConfig) -> None:
    from lerobot_pf2mp.dataset_tools.fetch_dataset import FETCH_OF_TASK
    from lerobot_pf2mp.dataset_tools.train_expert import train_expert

    if config.task not in FETCH_OF_TASK:
        raise ValueError(f"task must be one of {list(FETCH_OF_TASK)}, got {config.task!r}")
    output_dir = _given("--output_dir", config.output_dir).expanduser()
    expert = train_expert(
        FETCH_OF_TASK[config.task],
        config.algo,
        config.total_steps,
        output_dir,
        save_freq=config.save_freq,
        device=config.device,
        reward=config.reward,
        collision_penalty=config.collision_penalty,
        seed=config.seed,
        scene_changes=asdict(config.scene),
        options=config.options,
    )
    print(f"{expert.description} is in {output_dir}.")


def _convert(config: ConvertConfig) -> None:
    source = config.source
    if source.path is None:
        raise ValueError("--source.path must name the recording, got none")
    if source.type in ("d4rl", "minari"):
        _convert_maze(config, source.path)
    elif source.type == "fetch":
        _convert_fetch(config, source.path)
    else:
        raise ValueError(f"--source.type must be one of ['d4rl', 'minari', 'fetch'], got {source.type!r}")


def _convert_maze(config: ConvertConfig, path: Path) -> None:
    from lerobot_pf2mp.dataset_tools.convert_d4rl import read_d4rl
    from lerobot_pf2mp.dataset_tools.convert_minari import read_minari
    from lerobot_pf2mp.dataset_tools.fetch_dataset import FETCH_OF_TASK
    from lerobot_pf2mp.dataset_tools.maze_dataset import maze_of, write_maze_dataset

    if config.task in FETCH_OF_TASK:
        raise ValueError(f"--source.type must be fetch for {config.task}, got {config.source.type!r}")
    maze = maze_of(config.task, config.maze_map)
    if config.source.type == "d4rl":
        trajectories: Any = read_d4rl(path, maze)
        n_expected = len(trajectories)
    else:
        n_expected, trajectories = read_minari(path)
    repo_id, root = _dataset_place(config)
    n_steps = 80 if config.n_steps is None else config.n_steps
    n_written, dropped = write_maze_dataset(
        trajectories,
        root=root,
        repo_id=repo_id,
        maze=maze,
        origin=f"Converted from {path.name} ({config.source.type}).",
        n_steps=n_steps,
        n_episodes=config.n_episodes,
        n_expected=n_expected,
        overwrite=config.overwrite,
    )
    _report(n_written, n_steps, dropped, root)


def _convert_fetch(config: ConvertConfig, path: Path) -> None:
    from lerobot_pf2mp.dataset_tools.convert_fetch import convert_fetch
    from lerobot_pf2mp.dataset_tools.fetch_dataset import FETCH_OF_TASK

    if config.maze_map is not None:
        raise ValueError(f"--maze_map is for mazes only, got {config.maze_map}")
    if config.task not in FETCH_OF_TASK:
        raise ValueError(f"task must be one of {list(FETCH_OF_TASK)}, got {config.task!r}")
    repo_id, root = _dataset_place(config)
    n_steps = 48 if config.n_steps is None else config.n_steps
    n_written, dropped = convert_fetch(
        path,
        FETCH_OF_TASK[config.task],
        root=root,
        repo_id=repo_id,
        n_steps=n_steps,
        scene_changes=asdict(config.scene),
        n_episodes=config.n_episodes,
        overwrite=config.overwrite,
    )
    _report(n_written, n_steps, dropped, root)


def _fit_field(config: FitFieldConfig) -> None:
    from lerobot_pf2mp.fit_field import fit_field

    policy, dataset = config.policy, config.dataset
    path = _given("--policy.path", policy.path)
    repo_id = _given("--dataset.repo_id", dataset.repo_id)
    output_dir = _given("--output_dir", config.output_dir)
    changed = {name: value for name, value in asdict(policy).items() if value is not None}
    del changed["path"]
    revision = changed.pop("revision", None)
    fitted = fit_field(
        Path(path).expanduser() if Path(path).expanduser().is_dir() else path,
        output_dir.expanduser(),
        repo_id=repo_id,
        root=dataset.root and dataset.root.expanduser(),
        episodes=dataset.episodes,
        dataset_revision=dataset.revision,
        checkpoint_revision=revision,
        options=changed,
        overwrite=config.overwrite,
    )
    print(f"Wrote a {fitted.type} checkpoint to {output_dir}.")


def _demo(config: DemoConfig) -> None:
    from lerobot_pf2mp.demo import run_demo

    run_demo(
        config.output_dir.expanduser(),
        task=config.task,
        n_demonstrations=config.n_demonstrations,
        steps=config.steps,
        n_episodes=config.n_episodes,
        seed=config.seed,
    )


def _benchmark(config: BenchmarkConfig) -> None:
    from lerobot_pf2mp.benchmark import run_benchmark

    output_dir = config.output_dir.expanduser()
    run_benchmark(_benchmark_spec(config), output_dir, n_processes=config.n_processes)
    print(f"{(output_dir / 'table.md').read_text(encoding='utf-8')}\nWrote {output_dir}.")


def _benchmark_spec(config: BenchmarkConfig) -> BenchmarkSpec:
    from lerobot_pf2mp.benchmark import BenchmarkSpec, Guidance

    return BenchmarkSpec(
        env=config.env,
        tasks=tuple(config.tasks or [str(config.env.task)]),
        policies=config.policies,
        guidances=tuple(guidance for text in config.guidance for guidance in Guidance.parse(text)),
        variants=config.variants,
        seeds=tuple(config.seeds),
        n_repeats=config.n_repeats,
        n_episodes=config.n_episodes,
        episode_seed=config.episode_seed,
        batch_size=config.batch_size,
        device=config.device,
    )


def _plot(config: PlotConfig) -> None:
    from lerobot_pf2mp import plots
    from lerobot_pf2mp.figures import FIGURES, GuidedPolicyFigures, make_lambda_figure

    for option, value, choices in (
        ("--figure", config.figure, FIGURES),
        ("--background", config.background, tuple(plots.THEMES)),
    ):
        if value not in choices:
            raise ValueError(f"{option} must be one of {choices}, got {value!r}")
    if config.n_episodes < 1 or any(episode < 0 for episode in config.episodes):
        raise ValueError(
            f"--n_episodes must be at least 1 and --episodes at least 0, got {config.n_episodes} and {config.episodes}"
        )
    output = _given("--output", config.output).expanduser()
    wanted = {"flow": ".gif", "video": ".mp4"}.get(config.figure, ".png")
    if output.suffix != wanted:
        raise ValueError(f"--output must end in {wanted} for this figure, got {output}")
    if config.figure == "lambda":
        if not config.results:
            raise ValueError("--results must name folders written by pf2mp-benchmark, got none")
        results = [path.expanduser() for path in config.results]
        make_lambda_figure(results, output, task=config.task, background=config.background)
    else:
        checkpoint = _given("--checkpoint", config.checkpoint)
        figures = GuidedPolicyFigures(checkpoint, config.env, seed=config.seed, options=config.options)
        figures.draw(config.figure, output, config.n_episodes, config.episodes, config.background)
    print(f"Wrote {output}.")


def _given[T](option: str, value: T | None) -> T:
    if value is None:
        raise ValueError(f"{option} must be given")
    return value


def _dataset_place(config: CollectConfig | ConvertConfig) -> tuple[str, Path]:
    from lerobot.utils.constants import HF_LEROBOT_HOME

    repo_id = config.repo_id or f"local/{'maze' if config.maze_map else config.task}"
    return repo_id, (config.root or HF_LEROBOT_HOME / repo_id).expanduser()


def _report(n_episodes: int, n_steps: int, dropped: Counter[str], root: Path) -> None:
    left_out = ", ".join(f"{count} {reason}" for reason, count in dropped.items()) or "none"
    print(f"Wrote {n_episodes} episodes of {n_steps} steps to {root} (left out: {left_out}).")


def _run(config_class: type, main: Callable[[Any], None]) -> None:
    """Parses the command line and runs a command; whatever a user can cause ends in one line and a non-zero code."""
    # LeRobot's lengthy warning about a video decoder that these commands do not use.
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
    try:
        main(draccus.parse(config_class))
    except KeyboardInterrupt:
        print("interrupted: nothing half-written was left behind", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except (
        draccus.utils.DecodingError,
        draccus.utils.ParsingError,
        ValueError,
        RuntimeError,
        OSError,
        ImportError,
    ) as error:
        print("error:", " ".join(str(error).split()), file=sys.stderr)
        sys.exit(1)
