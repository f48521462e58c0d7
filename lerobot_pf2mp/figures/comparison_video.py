# SPDX-License-Identifier: Apache-2.0
"""Videos of two episodes side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from lerobot.utils.io_utils import write_video
from PIL import Image, ImageDraw, ImageFont

from lerobot_pf2mp.figures import COLLISION, GUIDED, THEMES
from lerobot_pf2mp.process.atomic_files import file_written_beside

FPS = 12  # slow enough to follow
_BANNER = 36  # height of the line above each picture [pixels]
_GAP = 6  # between the pictures [pixels]
_N_LAST = 12  # how often the last picture is repeated


def write_comparison(
    output: Path,
    unguided: Sequence[np.ndarray],
    guided: Sequence[np.ndarray],
    *,
    collisions: tuple[int | None, int | None],
    background: str = "light",
) -> None:
    """Writes two episodes side by side, without and with guidance, as an MP4 file.

    Args:
        output: The file to write.
        unguided: Pictures ``(H, W, 3)`` uint8 without guidance, one for each step.
        guided: The same with guidance; the shorter film stops at its last picture.
        collisions: Number of the picture in which each first collides; None if it does not.
        background: One of `plots.THEMES`.
    """
    theme = THEMES[background]
    n = max(len(unguided), len(guided))
    films = [
        [
            _captioned(
                film[min(i, len(film) - 1)],
                name + (" - collision" if hit is not None and i >= hit else ""),
                theme.background,
                COLLISION if hit is not None and i >= hit else colour,
            )
            for i in [*range(n), *[n - 1] * _N_LAST]
        ]
        for film, name, hit, colour in (
            (unguided, "without guidance", collisions[0], theme.text),
            (guided, "with guidance", collisions[1], GUIDED),
        )
    ]
    height = films[0][0].shape[0]
    gap = np.full((height, _GAP, 3), Image.new("RGB", (1, 1), theme.background).getpixel((0, 0)), np.uint8)
    frames = [np.concatenate([left, gap, right], axis=1) for left, right in zip(*films, strict=True)]
    with file_written_beside(output) as partial:
        write_video(partial, frames, FPS)


def _captioned(picture: np.ndarray, text: str, background: str, colour: str) -> np.ndarray:
    height, width, _ = picture.shape
    canvas = Image.new("RGB", (width, height + _BANNER), background)
    canvas.paste(Image.fromarray(picture), (0, _BANNER))
    font = ImageFont.load_default(size=20)
    ImageDraw.Draw(canvas).text((width / 2, _BANNER / 2), text, fill=colour, font=font, anchor="mm")
    return np.asarray(canvas)
