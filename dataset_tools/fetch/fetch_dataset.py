# SPDX-License-Identifier: Apache-2.0
"""The common parts of all Fetch datasets: features and card."""

from __future__ import annotations

from typing import Any

from lerobot_pf2mp.dataset_tools.writing.card import card_header
from lerobot_pf2mp.dataset_tools.writing.episodes import IMAGE_KEY
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, image_feature

ROBOT = "fetch"
FPS = 25
TASK_DESCRIPTIONS = {
    "reach": "Move the gripper to the red goal without touching the wall.",
    "push": "Push the block to the red goal without touching the wall.",
}

_XYZ = ["x", "y", "z"]
_OBJECTS = {"reach": ["goal"], "push": ["block", "goal"]}

_CARD = """\
{header}# {title}

{description} A Fetch robot in MuJoCo, and none of its demonstrations touches the wall. {origin}

Every demonstration is resampled to {n_steps} steps by linear interpolation in time; {fps} fps is nominal.

| feature | meaning | unit |
|---|---|---|
| `observation.state` | position x, y, z of the gripper | m |
| `observation.environment_state` | positions x, y, z of {objects}, unless there is a camera | m |
| `action` | next position x, y, z of the gripper | m |
| `observation.image` | if present: the scene, from in front of the table | |

x points away from the robot, y to its left, z up; the table's top is at z = 0.40 m. Made with lerobot_policy_pf2mp.
"""


def fetch_spec(
    task: str, repo_id: str, origin: str, n_steps: int, image_size: tuple[int, int] | None = None
) -> DatasetSpec:
    """The metadata of a Fetch dataset.

    Args:
        task: reach or push.
        repo_id: The dataset's name, ``user/name``.
        origin: A sentence for the card about the source of the demonstrations.
        n_steps: Steps that each is resampled to.
        image_size: Height and width of the images that are recorded instead of positions of block and goal [pixels]; None
            records the positions.
    """
    description = TASK_DESCRIPTIONS[task]
    objects = " and ".join(_OBJECTS[task])
    card = _CARD.format(
        header=card_header("fetch"),
        title=repo_id,
        description=description,
        origin=origin,
        n_steps=n_steps,
        fps=FPS,
        objects=objects,
    )
    features = _features_of(task)
    if image_size is not None:
        del features["observation.environment_state"]
        features[IMAGE_KEY] = image_feature(image_size)
    return DatasetSpec(repo_id, FPS, features, description, card, ROBOT)


def _features_of(task: str) -> dict[str, dict[str, Any]]:
    names = [f"{name}_{axis}" for name in _OBJECTS[task] for axis in _XYZ]
    return {
        "observation.state": {"dtype": "float32", "shape": (3,), "names": _XYZ},
        "observation.environment_state": {"dtype": "float32", "shape": (len(names),), "names": names},
        "action": {"dtype": "float32", "shape": (3,), "names": _XYZ},
    }
