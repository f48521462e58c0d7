# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import av
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from lerobot_pf2mp.figures import COLLISION, THEMES, comparison_video
from lerobot_pf2mp.figures.comparison_video import write_comparison

BANNER, GAP, N_LAST = comparison_video._BANNER, comparison_video._GAP, comparison_video._N_LAST


def film_of(*greys: int) -> list[np.ndarray]:
    return [np.full((60, 240, 3), grey, dtype=np.uint8) for grey in greys]


def frames_of(path: Path) -> np.ndarray:
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]).astype(int)


def n_coloured(pictures: np.ndarray, colour: str) -> list[int]:
    """The number of pixels with about a colour in each of ``(N, H, W, 3)`` images."""
    wanted = 255 * np.array(to_rgb(colour))
    return (np.abs(pictures - wanted).max(axis=-1) < 70).sum(axis=(1, 2)).tolist()


@pytest.mark.parametrize("background", list(THEMES))
def test_two_videos_run_side_by_side_and_a_collision_is_written_from_when_it_happens(
    tmp_path: Path, background: str
) -> None:
    output = tmp_path / "new" / "video.mp4"
    unguided, guided = film_of(40, 80, 120, 160), film_of(200, 220)
    write_comparison(output, unguided, guided, collisions=(2, None), background=background)
    assert [path.name for path in output.parent.iterdir()] == ["video.mp4"]
    frames = frames_of(output)
    assert frames.shape == (4 + N_LAST, 60 + BANNER, 240 + GAP + 240, 3)
    left, right = frames[:, BANNER:, :240], frames[:, BANNER:, -240:]
    greys = [np.median(half, axis=(1, 2, 3)) for half in (left, right)]
    np.testing.assert_allclose(greys[0], [40, 80, 120] + [160] * (1 + N_LAST), atol=6)
    np.testing.assert_allclose(greys[1], [200] + [220] * (3 + N_LAST), atol=6)
    red_left = n_coloured(frames[:, :BANNER, :240], COLLISION)
    assert max(red_left[:2]) < 5 < 50 < min(red_left[2:])
    assert max(n_coloured(frames[:, :BANNER, -240:], COLLISION)) < 5
    corner = frames[0, 3, 3]
    np.testing.assert_allclose(corner, 255 * np.array(to_rgb(THEMES[background].background)), atol=6)


def test_a_video_that_cannot_be_written_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write_half(path: Path, frames: list, fps: int) -> None:
        path.write_bytes(b"half")
        raise OSError("no space left")

    monkeypatch.setattr(comparison_video, "write_video", write_half)
    with pytest.raises(OSError, match="no space left"):
        write_comparison(tmp_path / "v.mp4", film_of(0), film_of(0), collisions=(None, None))
    assert not list(tmp_path.iterdir())
