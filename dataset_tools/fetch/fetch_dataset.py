# SPDX-License-Identifier: Apache-2.0
"""What all Fetch datasets have in common: features and card."""

from __future__ import annotations

from typing import Any

from lerobot_pf2mp.dataset_tools.writing.episodes import PICTURES
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, picture_feature

FPS = 25
TASK_DESCRIPTIONS = {
    "reach": "Move the gripper to the red goal without touching the wall.",
    "push": "Push the block to the red goal without touching the wall.",
}

_XYZ = ["x", "y", "z"]
_PLACES = {"reach": ["goal"], "push": ["block", "goal"]}

_CARD = """\
---
license: apache-2.0
task_categories: [robotics]
tags: [LeRobot, pf2mp, fetch]
---
# {title}

{description} A Fetch robot in MuJoCo, and none of its demonstrations touches the wall. {origin}

Every demonstration is resampled to {n_steps} steps by linear interpolation in time; {fps} fps is nominal.

| feature | meaning | unit |
|---|---|---|
| `observation.state` | position x, y, z of the gripper | m |
| `observation.environment_state` | positions x, y, z of {places}, unless there is a camera | m |
| `action` | next position x, y, z of the gripper | m |
| `observation.image` | if present: the scene, from in front of the table | |

x points away from the robot, y to its left, z up; the table's top is at z = 0.40 m. Made with lerobot_policy_pf2mp.
"""


def fetch_spec(
    task: str, repo_id: str, origin: str, n_steps: int, picture_size: tuple[int, int] | None = None
) -> DatasetSpec:
    """What a Fetch dataset holds besides its episodes.

    Args:
        task: reach or push.
        repo_id: The dataset's name, ``user/name``.
        origin: A sentence for the card: where the demonstrations come from.
        n_steps: Steps that each is resampled to.
        picture_size: Height and width of the pictures that are recorded instead of places [pixels]; None for places.
    """
    description = TASK_DESCRIPTIONS[task]
    places = " and ".join(_PLACES[task])
    card = _CARD.format(
        title=repo_id, description=description, origin=origin, n_steps=n_steps, fps=FPS, places=places
    )
    features = _features_of(task)
    if picture_size is not None:
        del features["observation.environment_state"]
        features[PICTURES] = picture_feature(picture_size)
    return DatasetSpec(repo_id, FPS, features, description, card)


def _features_of(task: str) -> dict[str, dict[str, Any]]:
    places = [f"{place}_{axis}" for place in _PLACES[task] for axis in _XYZ]
    return {
        "observation.state": {"dtype": "float32", "shape": (3,), "names": _XYZ},
        "observation.environment_state": {"dtype": "float32", "shape": (len(places),), "names": places},
        "action": {"dtype": "float32", "shape": (3,), "names": _XYZ},
    }
