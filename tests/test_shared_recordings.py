# SPDX-License-Identifier: Apache-2.0
"""The recordings by others themselves, where they lie beside the repository."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from lerobot_pf2mp.dataset_tools.handwriting.convert_handwriting import convert_handwriting
from lerobot_pf2mp.dataset_tools.handwriting.handwriting_recording import read_handwriting
from lerobot_pf2mp.dataset_tools.handwriting.matlab_file import read_matlab_variables

DATA = Path(__file__).parents[2] / "shared" / "data"
TABLET, PANDA, OMNIGLOT = (
    DATA / "handwriting_tablet",
    DATA / "panda_symbols" / "symbol_17.mat",
    DATA / "omniglot" / "strokes_background_small1.zip",
)

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the recordings by others are not there")


def test_the_tablet_s_drawing_is_five_strokes_in_millimetres() -> None:
    lines: list[str] = []
    strokes = read_handwriting(TABLET / "signal.svc", strokes="each", tell=lines.append)
    assert "millimetres, because not all are whole numbers" in lines[0]
    # The samples with pen status 1, as many in a row as there are.
    assert [len(each.times) for each in strokes] == [226, 133, 90, 203, 167]
    lengths = [np.linalg.norm(np.diff(each.values, axis=0), axis=1).sum() for each in strokes]
    np.testing.assert_allclose(lengths, [0.0366, 0.0150, 0.0051, 0.0176, 0.0191], atol=0.001)
    with pytest.raises(ValueError, match="got the pen lifted in row 226 of the drawing of .*5 strokes"):
        read_handwriting(TABLET / "signal.svc")


def test_the_first_hundred_samples_of_the_tablet_s_json_are_one_stroke() -> None:
    (stroke,) = read_handwriting(TABLET / "signal.json", scale=0.001, place=[0.4, 0.0])
    np.testing.assert_allclose(stroke.values[0], [0.45281, 0.05281])
    assert len(stroke.times) == 100


def test_the_recordings_of_the_panda_are_those_that_scipy_reads() -> None:
    theirs = scipy.io.loadmat(PANDA, simplify_cells=True)["symbol_data"]
    _, ours = read_matlab_variables(PANDA, ["symbol_data"])
    for one, other in zip(ours["symbol_data"], theirs, strict=True):
        for field in ("pos", "vel", "F"):
            np.testing.assert_array_equal(one[field], other[field])


def test_the_recordings_of_the_panda_become_a_dataset(tmp_path: Path) -> None:
    recordings = read_handwriting(PANDA)
    assert [len(each.times) for each in recordings] == [5520, 5471, 8647, 9637, 17703, 15523]
    options = {"root": tmp_path / "d", "repo_id": "a/b", "n_steps": 64, "scene_options": {"n_regions": 0}}
    assert convert_handwriting(PANDA, "pen", **options) == (6, Counter())


@pytest.mark.slow
def test_all_drawings_of_omniglot_can_be_read() -> None:
    counts = {"Balinese": 24, "Early_Aramaic": 22, "Greek": 24, "Korean": 40, "Latin": 26}
    n_drawings, left_out = 0, Counter[str]()
    for alphabet, n_characters in counts.items():
        for number in range(1, n_characters + 1):
            character = f"{alphabet}/character{number:02}"
            strokes = read_handwriting(OMNIGLOT, character=character, strokes="1", left_out=left_out)
            n_drawings += len(strokes)
            assert all(each.times[0] < each.times[-1] for each in strokes)
    assert n_drawings + sum(left_out.values()) == 2720
    assert left_out["whose times do not increase"] == 95
    assert set(left_out) == {"whose times do not increase", "shorter than 3 samples"}


def test_the_joints_of_another_arm_are_refused_naming_the_row(tmp_path: Path) -> None:
    options = {"root": tmp_path / "d", "repo_id": "a/b", "n_steps": 64, "scene_options": {"n_regions": 0}}
    with pytest.raises(ValueError, match=r"within the arm's limits, joint_4 in .* got 0 in row 0"):
        convert_handwriting(DATA / "panda_arm" / "trajectories.csv", "pen", **options)
