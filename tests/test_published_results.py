# SPDX-License-Identifier: Apache-2.0
"""The published tables are made from the published rows."""

from pathlib import Path

import pytest

from lerobot_pf2mp.results import SummaryRow, group_cells, read_rows
from lerobot_pf2mp.tables import make_latex, make_markdown

ROOT = Path(__file__).parents[1]
RESULTS = sorted(path.parent for path in (ROOT / "results").rglob("summary.csv"))


@pytest.mark.parametrize("folder", RESULTS, ids=lambda path: path.name)
def test_tables_are_made_from_the_rows_beside_them(folder: Path) -> None:
    cells = group_cells(read_rows(folder / "summary.csv", SummaryRow))
    assert (folder / "table.md").read_text(encoding="utf-8") == make_markdown(cells)
    assert (folder / "table.tex").read_text(encoding="utf-8") == make_latex(cells)


def test_the_readme_shows_the_table_of_the_mazes() -> None:
    assert (ROOT / "results/maze/table.md").read_text(encoding="utf-8") in (ROOT / "README.md").read_text(
        encoding="utf-8"
    )


@pytest.mark.parametrize("folder", RESULTS, ids=lambda path: path.name)
def test_published_rows_name_no_place_of_the_machine_they_were_made_on(folder: Path) -> None:
    for row in read_rows(folder / "summary.csv", SummaryRow):
        assert not Path(row.checkpoint).is_absolute()
