# SPDX-License-Identifier: Apache-2.0
"""The image on the sheet: the letter to write, and the restricted regions."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

from lerobot_pf2mp.envs.handwriting.sheet import SHEET_CENTRE, SHEET_SIDE
from lerobot_pf2mp.envs.handwriting.writing_scene import WritingScene

_PAPER, _LETTER, _REGION, _EDGE = (228, 228, 226), (150, 156, 165), (205, 70, 62), (170, 30, 26)
_LETTER_WIDTH = 0.004  # [m]
_SIDE = 1024  # [pixels]


def draw_sheet(scene: WritingScene) -> np.ndarray:
    """A square image ``(H, W, 3)`` uint8 of the sheet, its top row at the largest y."""
    image = Image.new("RGB", (_SIDE, _SIDE), _PAPER)
    draw = ImageDraw.Draw(image)
    for region in scene.regions:
        draw.polygon(_pixels(region.outline), fill=_REGION, outline=_EDGE, width=3)
    width = round(_LETTER_WIDTH / SHEET_SIDE * _SIDE)
    draw.line(_pixels(scene.stroke), fill=_LETTER, width=width, joint="curve")
    return np.asarray(image)


def _pixels(positions: np.ndarray) -> list[tuple[float, float]]:
    relative = (positions - np.array(SHEET_CENTRE)) / SHEET_SIDE + 0.5
    return [(float(x) * _SIDE, float(1 - y) * _SIDE) for x, y in relative]
