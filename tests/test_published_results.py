# SPDX-License-Identifier: Apache-2.0
"""The published tables are made from the published rows."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_pf2mp.results.rate import Rate
from lerobot_pf2mp.results.rows import SummaryRow, read_rows
from lerobot_pf2mp.results.summary import group_cells
from lerobot_pf2mp.results.tables import make_latex, make_markdown

ROOT = Path(__file__).parents[1]
RESULTS = sorted(path.parent for path in (ROOT / "results").rglob("summary.csv"))


@pytest.mark.parametrize("folder", RESULTS, ids=lambda path: path.name)
def test_tables_are_made_from_the_rows_beside_them(folder: Path) -> None:
    cells = group_cells(read_rows(folder / "summary.csv", SummaryRow))
    assert (folder / "table.md").read_text(encoding="utf-8") == make_markdown(cells)
    assert (folder / "table.tex").read_text(encoding="utf-8") == make_latex(cells)


def test_the_table_of_the_demo_is_made_from_its_rows() -> None:
    rows = read_rows(ROOT / "results/demo/results.csv", SummaryRow)
    lines = (ROOT / "results/demo/table.md").read_text(encoding="utf-8").splitlines()
    for row, line in zip(rows, lines[2:], strict=True):
        assert row.collisions is not None
        rates = Rate(row.collisions, row.n_episodes), Rate(row.successes, row.n_episodes)
        assert line == f"| {row.policy} | {rates[0]} | {rates[1]} | {row.n_episodes} |"


@pytest.mark.parametrize(
    "page", ["README.md", "results/ABLATIONS.md", "results/BENCHMARKS.md", "results/FAULTS.md"]
)
def test_pages_show_the_tables_as_they_are(page: str, tmp_path: Path) -> None:
    copy = tmp_path / "page.md"
    shutil.copy(ROOT / page, copy)
    subprocess.run([sys.executable, ROOT / ".ci/fill_tables", copy], check=True)
    assert copy.read_text(encoding="utf-8") == (ROOT / page).read_text(encoding="utf-8")


def test_every_published_table_is_on_a_page() -> None:
    pages = [(ROOT / page).read_text(encoding="utf-8") for page in ("README.md", "results/ABLATIONS.md")]
    for folder in RESULTS:
        if folder.name != "maze_lambda":  # a figure
            assert any((folder / "table.md").read_text(encoding="utf-8") in page for page in pages)


@pytest.mark.parametrize(
    "config", sorted((ROOT / "eval_configs/ablations").iterdir()), ids=lambda path: path.stem
)
def test_every_ablation_has_its_command_beside_its_table(config: Path) -> None:
    page = (ROOT / "results/ABLATIONS.md").read_text(encoding="utf-8")
    command = f"pf2mp-benchmark --config_path={config.relative_to(ROOT)} --n_processes=2"
    table = f"<!-- results/ablations/{config.stem}/table.md -->"
    section = next(part for part in page.split("\n## ") if table in part)
    assert command in section
    assert f"output_dir: results/ablations/{config.stem}\n" in config.read_text(encoding="utf-8")


@pytest.mark.parametrize("folder", RESULTS, ids=lambda path: path.name)
def test_published_rows_name_no_place_of_the_machine_they_were_made_on(folder: Path) -> None:
    for row in read_rows(folder / "summary.csv", SummaryRow):
        assert not Path(row.checkpoint).is_absolute()
