# SPDX-License-Identifier: Apache-2.0
"""The command pf2mp-collect."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from lerobot_pf2mp.commands.command import write_and_report
from lerobot_pf2mp.commands.publishing import published_if_asked
from lerobot_pf2mp.commands.scene import SceneConfig
from lerobot_pf2mp.commands.writing import WritingConfig
from lerobot_pf2mp.envs.tasks import (
    FETCH_OF_TASK,
    FETCH_STEPS,
    HANDWRITING_STEPS,
    MAZE_OF_TASK,
    MAZE_STEPS,
    METAWORLD_OF_TASK,
    METAWORLD_STEPS,
    OBS_TYPES,
    ROBOTS,
    SO101_STEPS,
    SO101_TASK,
    SPACE_OF_TASK,
)


@dataclass
class CollectConfig(WritingConfig):
    """Makes demonstrations in a simulated environment and writes them as a LeRobotDataset.

    Examples:
        pf2mp-collect --task=maze_large --root=data/maze_large
        pf2mp-collect --task=maze_medium --n_episodes=500 --action_noise=0.5 --seed=1 --root=data/noisy
        pf2mp-collect --task=maze_large --repo_id=you/maze_large --push_to_hub=true
        pf2mp-collect --maze_map=1111111/1000001/1011101/1000001/1111111 --root=data/ring
        pf2mp-collect --task=fetch_push --style=hug --n_processes=2 --root=data/fetch_push_hug
        pf2mp-collect --task=fetch_reach --scene.wall_size=[0.3,0.04,0.25] --root=data/high_wall
        pf2mp-collect --task=fetch_reach --expert=outputs/expert_reach --root=data/fetch_reach_ppo
        pf2mp-collect --task=handwriting_joint --letter=S --n_episodes=20 --root=data/handwriting_S
        pf2mp-collect --task=handwriting_pen --robot=unitree_z1 --letter=S --root=data/handwriting_z1
        pf2mp-collect --task=handwriting_pen --scene_file=my_stroke.json --root=data/my_stroke
        pf2mp-collect --task=metaworld_push_wall --root=data/metaworld_push_wall
        pf2mp-collect --task=so101_fence --obs_type=pixels_agent_pos --image_width=96 --root=data/so101_fence
    """

    # Task to demonstrate: maze_umaze, maze_medium, maze_large, fetch_reach, fetch_push, handwriting_joint, handwriting_pen,
    # metaworld_reach_wall, metaworld_push_wall, metaworld_pick_place_wall or so101_fence.
    task: str = "maze_large"
    # Folder of the dataset; by default where LeRobot keeps the datasets of your Hub account.
    root: Path | None = None
    # Name of the dataset, user/name; by default local/TASK.
    repo_id: str | None = None
    # Demonstrations to write; by default 4000 for a maze, 1000 for Fetch, 20 for handwriting_joint, 10 for
    # handwriting_pen, 500 for Meta-World, 200 for so101_fence.
    n_episodes: int | None = None
    # Steps that each demonstration is resampled to; by default 80 for a maze, 48 for Fetch, 64 for handwriting. In
    # Meta-World, 112, and of so101_fence, 96, they are recorded as they are.
    n_steps: int | None = None
    # Mazes: standard deviation of the noise on the expert's force, relative to the largest force (100 N).
    action_noise: float = 0.0
    # Mazes: your own map instead of the task's: rows of 0 (free) and 1 (wall) separated by "/".
    maze_map: str | None = None
    # Handwriting: the arm, panda, or unitree_z1, which needs: pip install "lerobot_policy_pf2mp[z1]".
    robot: str = "panda"
    # Fetch: scripted, or the folder of an expert that pf2mp-train-expert trained in the same scene.
    expert: str = "scripted"
    # Fetch: distance of the scripted expert to the wall: clear (2 to 5 cm) or hug (2 to 10 mm). SO-101: height of the cube
    # above it: clear (15 to 35 mm) or hug (4 to 12 mm).
    style: str = "clear"
    # Fetch: the wall, and the ranges of positions of the gripper, the goal and the block.
    scene: SceneConfig = field(default_factory=SceneConfig)
    # state, or pixels_agent_pos: camera images are recorded as a video instead of the positions of goal and block. Evaluate
    # such policies with the same --env.obs_type and --env.render_size.
    obs_type: str = "state"
    # Width of these images, for a maze their longer side [pixels].
    image_width: int = 128
    # Fetch: number of parallel processes.
    n_processes: int = 1
    # Seed of all random numbers.
    seed: int = 0
    # Whether to replace an existing dataset.
    overwrite: bool = False
    # Whether to publish the dataset on the Hugging Face Hub under the name --repo_id. You must be logged in there.
    push_to_hub: bool = False
    # Whether a new repository on the Hub is private.
    private: bool | None = None


def main(config: CollectConfig) -> None:
    """Runs the command."""
    with published_if_asked(config.repo_id, config.root, config.push_to_hub, config.private):
        _collect(config)


def _collect(config: CollectConfig) -> None:
    if config.obs_type not in OBS_TYPES:
        raise ValueError(f"obs_type must be one of {list(OBS_TYPES)}, got {config.obs_type!r}")
    if config.maze_map is not None and config.task not in MAZE_OF_TASK:
        raise ValueError(f"--maze_map is for mazes only, got {config.maze_map} for {config.task}")
    if config.robot not in ROBOTS:
        raise ValueError(f"robot must be one of {list(ROBOTS)}, got {config.robot!r}")
    if config.robot != "panda" and config.task not in SPACE_OF_TASK:
        raise ValueError(f"--robot is for handwriting only, got {config.robot} for {config.task}")
    if config.task in MAZE_OF_TASK:
        _collect_maze(config)
    elif config.task in FETCH_OF_TASK:
        _collect_fetch(config, FETCH_OF_TASK[config.task])
    elif config.task in SPACE_OF_TASK:
        _collect_handwriting(config, SPACE_OF_TASK[config.task])
    elif config.task in METAWORLD_OF_TASK:
        _collect_metaworld(config, METAWORLD_OF_TASK[config.task])
    elif config.task == SO101_TASK:
        _collect_so101(config)
    else:
        tasks = [*MAZE_OF_TASK, *FETCH_OF_TASK, *SPACE_OF_TASK, *METAWORLD_OF_TASK, SO101_TASK]
        raise ValueError(f"task must be one of {tasks}, got {config.task!r}")


def _image_width(config: CollectConfig) -> int | None:
    return None if config.obs_type == "state" else config.image_width


def _collect_maze(config: CollectConfig) -> None:
    from lerobot_pf2mp.dataset_tools.maze.collect_maze import collect_maze
    from lerobot_pf2mp.dataset_tools.maze.maze_dataset import maze_of

    if config.expert != "scripted":
        raise ValueError(f"expert must be scripted for a maze, got {config.expert!r}")
    write = partial(
        collect_maze,
        maze_of(config.task, config.maze_map),
        n_episodes=4000 if config.n_episodes is None else config.n_episodes,
        action_noise=config.action_noise,
        image_width=_image_width(config),
        seed=config.seed,
    )
    write_and_report(config, "maze" if config.maze_map else config.task, MAZE_STEPS, write)


def _collect_fetch(config: CollectConfig, task: str) -> None:
    from lerobot_pf2mp.dataset_tools.fetch.collect_fetch import collect_fetch

    write = partial(
        collect_fetch,
        task,
        n_episodes=1000 if config.n_episodes is None else config.n_episodes,
        style=config.style,
        image_width=_image_width(config),
        scene_changes=asdict(config.scene),
        seed=config.seed,
        n_processes=config.n_processes,
        expert=None if config.expert == "scripted" else Path(config.expert).expanduser(),
    )
    write_and_report(config, config.task, FETCH_STEPS, write)


def _collect_handwriting(config: CollectConfig, space: str) -> None:
    from lerobot_pf2mp.dataset_tools.handwriting.collect_handwriting import collect_handwriting

    if config.expert != "scripted":
        raise ValueError(f"expert must be scripted for handwriting, got {config.expert!r}")
    default = {"joint": 20, "pen": 10}[space]
    write = partial(
        collect_handwriting,
        space,
        n_episodes=default if config.n_episodes is None else config.n_episodes,
        scene_options=config.scene_options,
        image_width=_image_width(config),
        seed=config.seed,
        robot=config.robot,
    )
    write_and_report(config, config.task, HANDWRITING_STEPS, write)


def _collect_metaworld(config: CollectConfig, task: str) -> None:
    from lerobot_pf2mp.dataset_tools.metaworld.collect_metaworld import collect_metaworld

    if config.expert != "scripted":
        raise ValueError(f"expert must be scripted for Meta-World, got {config.expert!r}")
    write = partial(
        collect_metaworld,
        task,
        n_episodes=500 if config.n_episodes is None else config.n_episodes,
        image_width=_image_width(config),
        seed=config.seed,
    )
    write_and_report(config, config.task, METAWORLD_STEPS, write)


def _collect_so101(config: CollectConfig) -> None:
    # First, because it says what to install.
    from lerobot_pf2mp.envs.so101.needs import check_so101

    check_so101()
    from lerobot_pf2mp.dataset_tools.so101.collect_so101 import collect_so101

    if config.expert != "scripted":
        raise ValueError(f"expert must be scripted for {SO101_TASK}, got {config.expert!r}")
    write = partial(
        collect_so101,
        n_episodes=200 if config.n_episodes is None else config.n_episodes,
        style=config.style,
        image_width=_image_width(config),
        seed=config.seed,
    )
    write_and_report(config, config.task, SO101_STEPS, write)
