# SPDX-License-Identifier: Apache-2.0
"""Features and card of the SO-101 datasets."""

from __future__ import annotations

from typing import Any

from lerobot_pf2mp.dataset_tools.writing.card import card_header
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, image_feature
from lerobot_pf2mp.envs.so101.fence_env import JOINTS, TASK_DESCRIPTION
from lerobot_pf2mp.envs.so101.fence_scene import SO101_FPS
from lerobot_pf2mp.envs.tasks import SO101_STEPS

IMAGE_KEY = "observation.images.front"
_ROBOT = "sim_so_follower"

_CARD = """\
{header}# {title}

{description} An SO-101 arm in the simulation of so101-nexus, moved through its LeRobot robot `{robot}`. No demonstration
touches the wall, or the table with the arm. A scripted expert moved it (style {style}, seed {seed}).

Every demonstration has {n_steps} frames at {fps} Hz, as LeRobot's recorder writes them: what the robot saw, and the joint
targets that it was sent then.

| feature | meaning | unit |
|---|---|---|
| `observation.state` | shoulder pan and lift, elbow flex, wrist flex and roll; opening of the gripper | degrees; 0 to 100 |
| `observation.environment_state` | x, y, z of the cube, x, y of the goal, unless there is a camera | m |
| `action` | targets of the same joints, and of the gripper | degrees; 0 to 100 |
| `observation.images.front` | if present: the scene from in front of the table, drawn with the shapes that collide | |

x points away from the arm's base, y to its left, z up. Made with lerobot_policy_pf2mp.
"""


def fence_spec(repo_id: str, style: str, seed: int, image_width: int | None) -> DatasetSpec:
    """The metadata of an SO-101 dataset.

    Args:
        repo_id: The dataset's name, ``user/name``.
        style: The expert's style.
        seed: The expert's seed.
        image_width: Height and width of the images that are recorded instead of the positions of cube and goal [pixels];
            None records the positions.
    """
    card = _CARD.format(
        header=card_header("so101"),
        title=repo_id,
        description=TASK_DESCRIPTION,
        robot=_ROBOT,
        style=style,
        seed=seed,
        n_steps=SO101_STEPS,
        fps=SO101_FPS,
    )
    joints: dict[str, Any] = {"dtype": "float32", "shape": (len(JOINTS),), "names": list(JOINTS)}
    features = {"observation.state": joints, "action": joints}
    if image_width is None:
        names = ["cube_x", "cube_y", "cube_z", "goal_x", "goal_y"]
        features["observation.environment_state"] = {"dtype": "float32", "shape": (5,), "names": names}
    else:
        features[IMAGE_KEY] = image_feature((image_width, image_width))
    return DatasetSpec(repo_id, SO101_FPS, features, TASK_DESCRIPTION, card, _ROBOT)
