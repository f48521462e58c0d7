# SPDX-License-Identifier: Apache-2.0
"""Features and card of datasets of Meta-World's tasks."""

from __future__ import annotations

from typing import Any

from lerobot_pf2mp.dataset_tools.writing.card import card_header
from lerobot_pf2mp.dataset_tools.writing.episodes import IMAGE_KEY
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, image_feature
from lerobot_pf2mp.envs.tasks import METAWORLD_FPS, METAWORLD_TASKS

_XYZ = ["x", "y", "z"]
_FEATURES: dict[str, dict[str, Any]] = {
    "observation.state": {"dtype": "float32", "shape": (4,), "names": [*_XYZ, "gripper"]},
    "observation.environment_state": {
        "dtype": "float32",
        "shape": (6,),
        "names": [f"{name}_{axis}" for name in ("object", "goal") for axis in _XYZ],
    },
    "action": {"dtype": "float32", "shape": (4,), "names": ["dx", "dy", "dz", "effort"]},
}

_CARD = """\
{header}# {title}

{description} Meta-World's {task} with its shipped scripted expert (seed {seed}). All demonstrations succeed, none touches
the wall. Every one has {n_steps} steps at {fps} Hz, and goes on after success.

| feature | meaning | unit |
|---|---|---|
| `observation.state` | position x, y, z of the hand, opening of the gripper | m, 0 to 1 |
| `observation.environment_state` | positions x, y, z of object and goal, unless there is a camera | m |
| `action` | executed displacement x, y, z of the hand's target, effort of the gripper; from -1 to 1 | cm, relative |
| `observation.image` | if present: the table | |

The actions are displacements: train guided policies with `--policy.field_over=integrated`,
`--policy.field_displacement_scale=0.01` and `--policy.field_action_dims=[0,1,2]`. Made with lerobot_policy_pf2mp.
"""


def metaworld_spec(
    task: str, repo_id: str, seed: int, n_steps: int, image_size: tuple[int, int] | None = None
) -> DatasetSpec:
    """The metadata of a dataset.

    Args:
        task: The task's name in Meta-World.
        repo_id: The dataset's name, ``user/name``.
        seed: Seed of the demonstrations.
        n_steps: Steps of each of them.
        image_size: Height and width of the images that are recorded instead of the positions of object and goal [pixels];
            None records the positions.
    """
    features = dict(_FEATURES)
    if image_size is not None:
        del features["observation.environment_state"]
        features[IMAGE_KEY] = image_feature(image_size)
    description = METAWORLD_TASKS[task]
    card = _CARD.format(
        header=card_header("metaworld"),
        title=repo_id,
        description=description,
        task=task,
        seed=seed,
        n_steps=n_steps,
        fps=METAWORLD_FPS,
    )
    return DatasetSpec(repo_id, METAWORLD_FPS, features, description, card, "sawyer")
