# SPDX-License-Identifier: Apache-2.0
"""The command pf2mp-train-expert."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from lerobot_pf2mp.commands.command import given
from lerobot_pf2mp.commands.scene import SceneConfig
from lerobot_pf2mp.envs.tasks import FETCH_OF_TASK


@dataclass
class TrainExpertConfig:
    """Trains an expert for Fetch by reinforcement learning, for pf2mp-collect --expert=FOLDER.

    Needs: pip install "lerobot_policy_pf2mp[experts]". Called again, it continues where it was interrupted, or up to a
    larger number of steps. The wall stops the robot. There is no penalty for touching it, unless --collision_penalty is set.

    Examples:
        pf2mp-train-expert --task=fetch_reach --output_dir=outputs/expert_reach
        pf2mp-train-expert --task=fetch_push --algo=sac_her --total_steps=1000000 --device=cuda \
--output_dir=outputs/expert_push
        pf2mp-train-expert --task=fetch_reach --collision_penalty=0.5 --options='{net_arch: [128, 128]}' \
--output_dir=outputs/careful
    """

    # Task to learn: fetch_reach or fetch_push.
    task: str = "fetch_reach"
    # ppo, or sac_her (SAC with hindsight experience replay); by default ppo for fetch_reach, sac_her for fetch_push.
    algo: str | None = None
    # Environment steps of 0.04 s in total, rounded up to whole rollouts (ppo: 2048 steps).
    total_steps: int = 1_000_000
    # Folder of the expert.
    output_dir: Path | None = None
    # dense: minus the distance to the goal [m]; sparse: 0 within 0.05 m of it, else -1. By default dense for ppo, sparse
    # for sac_her.
    reward: str | None = None
    # Subtracted from the reward of each step that touches the wall.
    collision_penalty: float = 0.0
    # The wall, and the ranges of positions of the gripper, the goal and the block.
    scene: SceneConfig = field(default_factory=SceneConfig)
    # Changes to the algorithm's hyperparameters, with the names of Stable-Baselines3.
    options: dict[str, Any] = field(default_factory=dict)
    # Seed of all random numbers.
    seed: int = 0
    # Environment steps between checkpoints.
    save_freq: int = 50_000
    # Device on which the networks are trained, cpu or cuda.
    device: str = "cpu"


def main(config: TrainExpertConfig) -> None:
    """Runs the command."""
    if config.task not in FETCH_OF_TASK:
        raise ValueError(f"task must be one of {list(FETCH_OF_TASK)}, got {config.task!r}")
    output_dir = given("--output_dir", config.output_dir).expanduser()
    from lerobot_pf2mp.dataset_tools.experts.train_expert import train_expert

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
