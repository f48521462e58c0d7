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

FPS = 12  # [Hz], slow enough for a viewer to follow
_BANNER = 36  # height of the title above each image [pixels]
_GAP = 6  # between the two images [pixels]
_N_LAST = 12  # number of repetitions of the last image


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
        unguided: Images ``(H, W, 3)`` uint8 without guidance, one for each step.
        guided: The same with guidance. The shorter video stops at its last image.
        collisions: Number of the first image with a collision, without and with guidance; None without a collision.
        background: One of `theme.THEMES`.
    """
    theme = THEMES[background]
    n = max(len(unguided), len(guided))
    videos = [
        [
            _captioned(
                video[min(i, len(video) - 1)],
                name + (" - collision" if hit is not None and i >= hit else ""),
                theme.background,
                COLLISION if hit is not None and i >= hit else colour,
            )
            for i in [*range(n), *[n - 1] * _N_LAST]
        ]
        for video, name, hit, colour in (
            (unguided, "without guidance", collisions[0], theme.text),
            (guided, "with guidance", collisions[1], GUIDED),
        )
    ]
    height = videos[0][0].shape[0]
    gap = np.full((height, _GAP, 3), Image.new("RGB", (1, 1), theme.background).getpixel((0, 0)), np.uint8)
    frames = [np.concatenate([left, gap, right], axis=1) for left, right in zip(*videos, strict=True)]
    with file_written_beside(output) as partial:
        write_video(partial, frames, FPS)


def _captioned(image: np.ndarray, text: str, background: str, colour: str) -> np.ndarray:
    height, width, _ = image.shape
    canvas = Image.new("RGB", (width, height + _BANNER), background)
    canvas.paste(Image.fromarray(image), (0, _BANNER))
    font = ImageFont.load_default(size=20)
    ImageDraw.Draw(canvas).text((width / 2, _BANNER / 2), text, fill=colour, font=font, anchor="mm")
    return np.asarray(canvas)
