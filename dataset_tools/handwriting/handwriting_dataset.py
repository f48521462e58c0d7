# SPDX-License-Identifier: Apache-2.0
"""The common parts of all handwriting datasets: features and card."""

from __future__ import annotations

from typing import Any

from lerobot_pf2mp.dataset_tools.writing.card import card_header
from lerobot_pf2mp.dataset_tools.writing.episodes import IMAGE_KEY
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, image_feature
from lerobot_pf2mp.envs.handwriting.arm import Arm
from lerobot_pf2mp.envs.handwriting.sheet import HANDWRITING_FPS

_MEANING = {
    "joint": "positions of {joints}",
    "pen": "position x, y of the pen's tip [m]",
}

_CARD = """\
{header}# {title}

{description} A {arm} writes with a pen in MuJoCo; no demonstration enters a region or touches the table. {origin}

Every demonstration has {n_steps} steps; {fps} fps.

| feature | meaning |
|---|---|
| `observation.state` | {meaning} |
| `action` | the next ones |
| `observation.image` | if present: arm and sheet from the side |

The frame is {frame}. Made with lerobot_policy_pf2mp.
"""


def handwriting_spec(
    space: str,
    arm: Arm,
    name: str,
    repo_id: str,
    origin: str,
    n_steps: int,
    image_size: tuple[int, int] | None = None,
) -> DatasetSpec:
    """The metadata of a handwriting dataset.

    Args:
        space: ``joint`` or ``pen``: states and actions are joint positions or positions of the pen's tip.
        arm: The arm.
        name: Name of the written letter or scene.
        repo_id: The dataset's name, ``user/name``.
        origin: A sentence for the card about the source of the demonstrations.
        n_steps: Steps of each demonstration.
        image_size: Height and width of a camera's images [pixels]; None without a camera.
    """
    description = f"Write {name} without entering a red region."
    card = _CARD.format(
        header=card_header("handwriting"),
        title=repo_id,
        description=description,
        origin=origin,
        n_steps=n_steps,
        fps=HANDWRITING_FPS,
        arm=arm.title,
        frame=_frame_of(arm),
        meaning=_MEANING[space].format(joints=arm.joints),
    )
    names = list(arm.joint_names) if space == "joint" else ["x", "y"]
    feature: dict[str, Any] = {"dtype": "float32", "shape": (len(names),), "names": names}
    features = {"observation.state": feature, "action": dict(feature)}
    if image_size is not None:
        features[IMAGE_KEY] = image_feature(image_size)
    return DatasetSpec(repo_id, HANDWRITING_FPS, features, description, card, arm.robot)


def _frame_of(arm: Arm) -> str:
    x, y, z = arm.position
    if not any(arm.position):
        return "that of the arm's base: x forward, y to its left"
    place = f"x = {x:g}, y = {y:g}, z = {z:g} m"
    return f"that of the table: x forward from the arm, y to its left; the arm's base is at {place}"
