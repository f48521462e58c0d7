# SPDX-License-Identifier: Apache-2.0
"""A slice of the fuzzer, and properties that hold for whatever is typed."""

import csv
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest
from draccus.utils import ParsingError
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_pf2mp.commands.collect import CollectConfig
from lerobot_pf2mp.commands.options import parse, read_config_file, read_option
from lerobot_pf2mp.envs.maze.point_maze import parse_maze_map
from lerobot_pf2mp.policies.processor_files import check_processors
from lerobot_pf2mp.results.rows import SummaryRow, read_rows

ROOT = Path(__file__).parents[1]
PLAIN = settings(derandomize=True, deadline=None, max_examples=300)
ANYTHING: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)


@pytest.mark.slow
def test_a_slice_of_the_fuzzer_finds_no_fault(tmp_path: Path) -> None:
    options = [
        "--n_inputs=400",
        "--seed=1",
        "--time_limit=120",
        f"--output_dir={tmp_path}",
        f"--keep={tmp_path / 'kept'}",
    ]
    fuzzed = subprocess.run(
        [sys.executable, ROOT / "tests/fuzzing", *options],
        capture_output=True, text=True, check=False, cwd=tmp_path, timeout=600,
    )  # fmt: skip
    assert fuzzed.returncode == 0, fuzzed.stdout + fuzzed.stderr[-3000:]
    assert (tmp_path / "table.md").read_text().count("\n") > 10


@PLAIN
@given(st.text(alphabet=st.characters(exclude_characters="\x00", exclude_categories=["Cs"])))
def test_whatever_is_typed_for_a_path_or_name_arrives(typed: str) -> None:
    if typed != "null":
        assert read_option(CollectConfig, "root", typed) == typed
    assert read_option(CollectConfig, "task", typed) == typed


@PLAIN
@given(st.text(max_size=20))
def test_whatever_is_typed_for_a_number_is_read_or_refused(typed: str) -> None:
    try:
        config = parse(CollectConfig, [f"--n_steps={typed}"])
    except ParsingError:
        return
    assert config.n_steps is None or isinstance(config.n_steps, int)


@PLAIN
@given(ANYTHING, st.sampled_from([".yaml", ".json"]))
def test_whatever_a_configuration_holds_is_read_or_refused(value: Any, suffix: str) -> None:
    with tempfile.NamedTemporaryFile("w", suffix=suffix) as file:
        file.write(json.dumps(value))
        file.flush()
        try:
            found = read_config_file(file.name, CollectConfig)
        except ParsingError:
            return
    assert isinstance(found, dict)


@PLAIN
@given(ANYTHING | st.text(alphabet="01/# OG\n", max_size=30))
def test_whatever_is_given_for_a_map_is_read_or_refused(value: Any) -> None:
    try:
        rows = parse_maze_map(value)
    except ValueError:
        return
    assert {cell for row in rows for cell in row} <= {0, 1} and rows[0][0] == 1


@PLAIN
@given(ANYTHING)
def test_whatever_a_processors_file_holds_is_accepted_or_refused(value: Any) -> None:
    with tempfile.TemporaryDirectory() as folder:
        step = (
            value if isinstance(value, dict) else {"registry_name": "normalizer_processor", "config": value}
        )
        (Path(folder) / "policy_preprocessor.json").write_text(json.dumps({"steps": [step]}))
        try:
            check_processors(folder)
        except ValueError:
            return
    assert isinstance(step.get("registry_name"), str)


@PLAIN
@given(st.integers(0, 18), st.text(max_size=12))
def test_whatever_a_result_holds_is_read_or_refused(column: int, text: str) -> None:
    lines = (ROOT / "results/maze_lambda/summary.csv").read_text().splitlines()[:2]
    cells = next(csv.reader([lines[1]]))
    cells[column] = text
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "summary.csv"
        with path.open("w", newline="", encoding="utf-8", errors="replace") as file:
            file.write(lines[0] + "\n")
            csv.writer(file, lineterminator="\n").writerow(cells)
        try:
            (row,) = read_rows(path, SummaryRow) or (None,)
        except ValueError:
            return
    assert row is None or isinstance(row, SummaryRow)
