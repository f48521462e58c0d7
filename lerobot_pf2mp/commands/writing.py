# SPDX-License-Identifier: Apache-2.0
"""Options of several commands: the letter to write, and the restricted regions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_pf2mp.envs.handwriting.sheet import LETTER_HEIGHT, N_REGIONS, REGION_GAP


@dataclass
class WritingConfig:
    """The letter to write, and the restricted regions."""

    # Handwriting: the letter, one of C G J L M N O S U V W Z 1 2 3 6 7 8 9.
    letter: str = "S"
    # Handwriting: height of the letter [m].
    letter_height: float = LETTER_HEIGHT
    # Handwriting: distance of the restricted regions to the letter [m].
    region_gap: float = REGION_GAP
    # Handwriting: largest number of restricted regions in the concave parts of the letter.
    n_regions: int = N_REGIONS
    # Handwriting: a JSON file with your own stroke and regions instead, {"stroke": [[x, y], ...], "regions":
    # [{"centre": [x, y], "radius": r}, {"corners": [[x, y], ...]}]} [m], x forward and y left of the Panda's base.
    scene_file: Path | None = None

    @property
    def scene_options(self) -> dict[str, Any]:
        """Arguments of `make_writing_scene`."""
        names = ("letter", "letter_height", "region_gap", "n_regions", "scene_file")
        return {name: getattr(self, name) for name in names}
