# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from result_rows import EPISODE, SUMMARY, UNGUIDED, cell, episodes

from lerobot_pf2mp.results.rate import Rate
from lerobot_pf2mp.results.rows import EpisodeRow, SummaryRow, format_row, read_rows, write_rows
from lerobot_pf2mp.results.summary import Cell, group_cells, summarise
from lerobot_pf2mp.results.tables import make_latex, make_markdown

# Rates


def test_the_wilson_interval_has_its_published_values() -> None:
    assert Rate(5, 10).interval == pytest.approx((0.2366, 0.7634), abs=1e-4)
    assert Rate(0, 10).interval == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert Rate(10, 10).interval == pytest.approx((0.7225, 1.0), abs=1e-4)
    assert str(Rate(1, 4)) == "25.0 % [4.6, 69.9]"


# Files


def awkward_rows() -> list[EpisodeRow]:
    rng = np.random.default_rng(0)
    values = [float(value) for value in 10.0 ** rng.uniform(-12, 12, size=20)]
    values += [0.1, 1 / 3, -0.0, 1e-300, 5e-324, 123456789.123456789, math.inf, -math.inf]
    rows = [replace(EPISODE, min_clearance_m=-value, guidance_scale=value) for value in values]
    nothing = {"collision": None, "min_clearance_m": None, "path_length_m": None, "steps": None}
    return [
        *rows,
        replace(EPISODE, **nothing, chunk_latency_ms=None, commit=""),
        replace(EPISODE, success=False, collision=True, steps=0, seed=2**40, episode=10**9),
        replace(EPISODE, policy='mine, the "new" one', variant="N=1, h=0.1", checkpoint="some, where/50 %"),
        replace(EPISODE, policy="größer ± λ", variant="none", checkpoint="None"),
    ]


def test_rows_come_back_as_they_were_bit_for_bit(tmp_path: Path) -> None:
    rows = awkward_rows()
    write_rows(tmp_path / "new/folder/rows.csv", rows, EpisodeRow)
    back = read_rows(tmp_path / "new/folder/rows.csv", EpisodeRow)
    # repr also distinguishes 0.0 from -0.0, and 1 from True.
    assert [repr(row) for row in back] == [repr(row) for row in rows]
    assert [path.name for path in (tmp_path / "new/folder").iterdir()] == ["rows.csv"]


def test_summaries_come_back_as_they_were(tmp_path: Path) -> None:
    rows = [
        SUMMARY,
        replace(SUMMARY, collisions=None, min_clearance_m=None, path_length_m=None, chunk_latency_ms=None),
        replace(SUMMARY, only_unguided_collides=8, only_guided_collides=0),
    ]
    write_rows(tmp_path / "rows.csv", rows, SummaryRow)
    assert [repr(row) for row in read_rows(tmp_path / "rows.csv", SummaryRow)] == [repr(row) for row in rows]


def test_no_rows_are_a_file_with_columns_only(tmp_path: Path) -> None:
    write_rows(tmp_path / "rows.csv", [], EpisodeRow)
    assert (tmp_path / "rows.csv").read_text() == ",".join(field.name for field in fields(EpisodeRow)) + "\n"
    assert read_rows(tmp_path / "rows.csv", EpisodeRow) == []


def test_yes_and_no_are_one_and_zero_and_what_is_not_reported_is_empty() -> None:
    row = replace(EPISODE, success=True, collision=None, min_clearance_m=0.1, steps=7)
    text = dict(zip((field.name for field in fields(EpisodeRow)), format_row(row), strict=True))
    assert (text["success"], text["collision"], text["min_clearance_m"], text["steps"]) == (
        "1",
        "",
        "0.1",
        "7",
    )


@pytest.mark.parametrize("n_characters", [1, 20, -1])
def test_a_last_line_that_was_cut_off_is_left_out(tmp_path: Path, n_characters: int) -> None:
    path = tmp_path / "rows.csv"
    write_rows(path, episodes([True, False, True]), EpisodeRow)
    *lines, last = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines) + last[:n_characters])
    assert read_rows(path, EpisodeRow) == episodes([True, False])


@pytest.mark.parametrize(
    "header",
    ["", "task,policy\n", "columns", ",".join(field.name for field in fields(SummaryRow)) + "\n"],
    ids=["empty", "other", "cut", "summary"],
)
def test_other_columns_are_an_error_that_names_those_there_should_be(tmp_path: Path, header: str) -> None:
    (tmp_path / "rows.csv").write_text(header)
    with pytest.raises(
        ValueError,
        match=r"rows.csv must have the columns \['task', .*'commit'\], and may have \['plans_drawn', .*'\], got \[",
    ):
        read_rows(tmp_path / "rows.csv", EpisodeRow)


PLAN_COLUMNS = {
    EpisodeRow: ["plans_drawn", "n_plans", "plan_flagged", "obstacle_collision"],
    SummaryRow: ["plans_drawn", "n_plans", "flagged", "flagged_collisions", "obstacle_collisions"],
}


@pytest.mark.parametrize("row", [EPISODE, SUMMARY], ids=["episodes", "summary"])
def test_a_file_from_before_plans_were_counted_is_read_without_them(
    tmp_path: Path, row: EpisodeRow | SummaryRow
) -> None:
    kind, path = type(row), tmp_path / "rows.csv"
    write_rows(path, [replace(row, plans_drawn=12, n_plans=3), row], kind)
    lines = [line.split(",") for line in path.read_text().splitlines()]
    n_added = len(PLAN_COLUMNS[kind])
    assert lines[0][-n_added:] == PLAN_COLUMNS[kind]
    for n_missing in range(n_added + 1):
        old = [line[: len(line) - n_missing] for line in lines]
        path.write_text("".join(",".join(line) + "\n" for line in old))
        drawn, n_plans = (
            (12, 3) if n_missing < n_added - 1 else (12, None) if n_missing < n_added else (None, None)
        )
        assert read_rows(path, kind) == [replace(row, plans_drawn=drawn, n_plans=n_plans), row]
    path.write_text(",".join(lines[0][:-n_added]) + "\n" + ",".join(lines[1]) + "\n")
    with pytest.raises(ValueError, match=f"a line must have {len(lines[0]) - n_added} values"):
        read_rows(path, kind)


def test_published_rows_of_before_are_read_without_plans() -> None:
    rows = read_rows(Path(__file__).parents[1] / "results/ablations/maze_three_seeds/summary.csv", SummaryRow)
    assert rows and all(getattr(row, name) is None for row in rows for name in PLAN_COLUMNS[SummaryRow])
    assert "flagged" not in make_markdown(group_cells(rows))


@pytest.mark.parametrize(
    ("column", "value"),
    [("success", "yes"), ("repeat", ""), ("repeat", "1.5"), ("guidance_scale", ""), ("steps", "many")],
)
def test_values_of_another_kind_are_an_error(tmp_path: Path, column: str, value: str) -> None:
    names = [field.name for field in fields(EpisodeRow)]
    values = format_row(EPISODE)
    values[names.index(column)] = value
    (tmp_path / "rows.csv").write_text(",".join(names) + "\n" + ",".join(values) + "\n")
    with pytest.raises(ValueError, match="rows.csv must hold one result on each line: "):
        read_rows(tmp_path / "rows.csv", EpisodeRow)


@pytest.mark.parametrize(
    "change", [lambda values: values[:-1], lambda values: [*values, "more"]], ids=["fewer", "more"]
)
def test_lines_with_more_or_fewer_values_than_columns_are_an_error(tmp_path: Path, change: Any) -> None:
    lines = [[field.name for field in fields(EpisodeRow)], change(format_row(EPISODE)), format_row(EPISODE)]
    (tmp_path / "rows.csv").write_text("".join(",".join(line) + "\n" for line in lines))
    with pytest.raises(ValueError, match="rows.csv must hold one result on each line"):
        read_rows(tmp_path / "rows.csv", EpisodeRow)


# Counting


def test_a_repeat_is_summarised_by_counts_and_means() -> None:
    rows = episodes([True, False, False, True])
    rows = [
        replace(row, success=success, min_clearance_m=clearance, path_length_m=length)
        for row, success, clearance, length in zip(
            rows, (True, True, True, False), (-0.5, 0.25, 0.5, 0.0), (1.0, 2.0, 4.0, 5.0), strict=True
        )
    ]
    (summary,) = summarise(rows)
    assert summary == replace(
        SUMMARY, n_episodes=4, successes=3, collisions=2, min_clearance_m=0.0625, path_length_m=3.0
    )


def test_plans_in_the_wall_are_counted() -> None:
    rows = [replace(row, plan_in_wall=row.episode in (0, 3)) for row in episodes([True, False, False, True])]
    (summary,) = summarise(rows)
    assert (summary.collisions, summary.plans_in_wall) == (2, 2)


def test_the_stroke_error_is_averaged_over_episodes_of_different_repeats() -> None:
    rows = [*episodes([False, False], stroke_error_mm=2.0), *episodes([False], repeat=1, stroke_error_mm=5.0)]
    summaries = summarise(rows)
    assert [row.stroke_error_mm for row in summaries] == [2.0, 5.0]
    (cell,) = group_cells(summaries)
    assert cell.stroke_error == pytest.approx(3.0)
    head, _, line = make_markdown([cell]).splitlines()
    assert head.split(" | ")[-2] == "stroke error [mm]" and line.split(" | ")[-2] == "3.00"
    assert make_markdown(group_cells(summarise(episodes([False])))).count("stroke") == 0


def test_what_an_environment_does_not_report_stays_none() -> None:
    (summary,) = summarise(
        episodes([None, None], min_clearance_m=None, path_length_m=None, steps=None, chunk_latency_ms=None)
    )
    assert summary == replace(
        SUMMARY,
        n_episodes=2,
        successes=2,
        collisions=None,
        min_clearance_m=None,
        path_length_m=None,
        chunk_latency_ms=None,
    )


@pytest.mark.parametrize(
    "other",
    [
        {"task": "MazeMedium-v0"},
        {"policy": "dppf"},
        {"guidance_integrator": "euler"},
        {"guidance_scale": 8.0},
        {"variant": "wide"},
        {"seed": 1},
        {"repeat": 1},
        {"checkpoint": "elsewhere"},
    ],
    ids=str,
)
def test_repeats_are_told_apart_by_all_that_they_are(other: dict[str, Any]) -> None:
    rows = [*episodes([True, False]), *episodes([True, True, True], **other)]
    summary = summarise(rows[::2] + rows[1::2])  # in whatever order
    assert [(row.n_episodes, row.collisions) for row in summary] == [(2, 1), (3, 3)]
    assert all(getattr(summary[1], name) == value for name, value in other.items())


def test_plans_flagged_episodes_and_collisions_among_them_are_counted() -> None:
    flagged = (True, False, True, False, True)
    rows = [
        replace(row, plans_drawn=10 + i, n_plans=i + 1, plan_flagged=is_flagged)
        for i, (row, is_flagged) in enumerate(
            zip(episodes([True, True, False, False, True]), flagged, strict=True)
        )
    ]
    (summary,) = summarise(rows)
    assert (summary.plans_drawn, summary.n_plans) == (60, 15)
    assert (summary.collisions, summary.flagged, summary.flagged_collisions) == (3, 3, 2)
    (silent,) = summarise([replace(row, collision=None) for row in rows])
    assert (silent.flagged, silent.flagged_collisions) == (3, None)
    (unmeasured,) = summarise(episodes([True, False]))
    assert [getattr(unmeasured, name) for name in PLAN_COLUMNS[SummaryRow]] == [None] * 5


# Twins


def test_guided_episodes_are_paired_with_the_same_episodes_of_their_twin() -> None:
    unguided = episodes([True, True, True, False, False, False, True], **UNGUIDED)
    guided = episodes([False, False, True, True, False, False, False])
    first, second = summarise([*unguided, *guided[::-1]])  # found by their number rather than their order
    assert (first.only_unguided_collides, first.only_guided_collides) == (None, None)
    assert (second.only_unguided_collides, second.only_guided_collides) == (3, 1)
    assert (first.collisions, second.collisions) == (4, 2)


def test_every_kind_of_guidance_is_paired_with_the_one_unguided_twin() -> None:
    rows = [
        *episodes([False, False], guidance_scale=8.0),  # before the twin
        *episodes([True, False], **UNGUIDED),
        *episodes([True, True], guidance_integrator="euler", guidance_scale=0.01),
    ]
    proximal, _, euler = summarise(rows)
    assert (proximal.only_unguided_collides, proximal.only_guided_collides) == (1, 0)
    assert (euler.only_unguided_collides, euler.only_guided_collides) == (0, 1)


@pytest.mark.parametrize(
    "other",
    [
        {"task": "MazeMedium-v0"},
        {"variant": "wide"},
        {"seed": 1},
        {"repeat": 1},
        {"checkpoint": "elsewhere"},
    ],
    ids=str,
)
def test_a_twin_has_the_same_task_variant_seed_repeat_and_checkpoint(other: dict[str, Any]) -> None:
    twin = episodes([True, True, False], **UNGUIDED)
    stranger = episodes([True, True, True], **{**UNGUIDED, **other})
    guided = episodes([False, False, False])
    assert summarise([*stranger, *guided])[-1].only_unguided_collides is None
    for rows in ([*stranger, *twin], [*twin, *stranger]):
        assert summarise([*rows, *guided])[-1].only_unguided_collides == 2


def test_without_all_episodes_of_a_twin_or_without_collisions_nothing_is_paired() -> None:
    guided, twin = episodes([False, True]), episodes([True, True], **UNGUIDED)
    for rows in (guided, [*twin[:1], *guided]):
        summary = summarise(rows)[-1]
        assert (summary.only_unguided_collides, summary.only_guided_collides) == (None, None)
    silent = summarise([*episodes([None, None], **UNGUIDED), *episodes([None, None])])[-1]
    assert (silent.only_unguided_collides, silent.only_guided_collides) == (None, None)


# Cells


@pytest.mark.parametrize(
    ("n_fixed", "n_broken", "expected"),
    [
        (8, 1, 2 * (1 + 9) / 2**9),  # C(9, 0) + C(9, 1)
        (1, 8, 2 * (1 + 9) / 2**9),
        (5, 0, 2 / 2**5),
        (10, 2, 2 * (1 + 12 + 66) / 2**12),  # C(12, 0) + C(12, 1) + C(12, 2)
        (1, 0, 1.0),
        (3, 3, 1.0),
        (0, 0, 1.0),
    ],
)
def test_the_p_value_is_that_of_the_exact_test_on_the_pairs_that_differ(
    n_fixed: int, n_broken: int, expected: float
) -> None:
    pairs = {"only_unguided_collides": n_fixed, "only_guided_collides": n_broken}
    assert cell(pairs).mcnemar_p == pytest.approx(expected, rel=1e-12)


def test_the_p_value_is_over_the_pairs_of_all_repeats_and_there_is_none_without_a_twin() -> None:
    repeats = [
        {"repeat": i, "only_unguided_collides": fixed, "only_guided_collides": broken}
        for i, (fixed, broken) in enumerate([(5, 0), (3, 1), (None, None)])
    ]
    assert cell(*repeats).mcnemar_p == pytest.approx(0.0390625, rel=1e-12)
    assert cell(repeats[-1]).mcnemar_p is None


def test_rates_are_over_all_episodes() -> None:
    both = cell({"collisions": 1, "successes": 49}, {"repeat": 1, "collisions": 3, "successes": 50})
    assert (both.n_episodes, both.n_seeds) == (100, 1)
    assert both.collision == Rate(4, 100)
    assert both.success == Rate(99, 100)
    assert cell({"collisions": None}).collision is None


MEASURED = {"plans_drawn": 150, "n_plans": 100, "collisions": 8, "flagged": 10, "flagged_collisions": 6}


def test_flagged_episodes_are_set_against_collisions_over_all_repeats_in_which_they_are_known() -> None:
    more = {
        "repeat": 1,
        "plans_drawn": 60,
        "n_plans": 100,
        "collisions": 2,
        "flagged": 0,
        "flagged_collisions": 0,
    }
    unmeasured = {"repeat": 2, "collisions": 30}
    for repeats in ([MEASURED, more], [unmeasured, MEASURED, more]):
        both = cell(*repeats)
        assert both.flagged == Rate(10, 100)
        assert both.unflagged_collision == Rate(2 + 2, 40 + 50)
        assert both.collision_flagged == Rate(6, 10)
        assert both.plans_drawn_each == pytest.approx(1.05)


def test_a_rate_of_nothing_is_none() -> None:
    nothing = cell({})
    rates = (
        nothing.flagged,
        nothing.unflagged_collision,
        nothing.collision_flagged,
        nothing.plans_drawn_each,
    )
    assert rates == (None, None, None, None)
    all_flagged = cell({**MEASURED, "flagged": 50, "flagged_collisions": 8})
    assert (all_flagged.flagged, all_flagged.unflagged_collision) == (Rate(50, 50), None)
    assert all_flagged.collision_flagged == Rate(8, 8)
    safe = cell({**MEASURED, "collisions": 0, "flagged_collisions": 0})
    assert (safe.unflagged_collision, safe.collision_flagged) == (Rate(0, 40), None)
    silent = cell({**MEASURED, "collisions": None, "flagged_collisions": None})
    assert (silent.flagged, silent.unflagged_collision, silent.collision_flagged) == (
        Rate(10, 50),
        None,
        None,
    )


def test_deviations_are_over_repeats_or_over_training_seeds_the_other_being_averaged() -> None:
    # Collisions of 50 episodes:      repeat 0  repeat 1   rate of the seed
    #                       seed 3        1         3            0.04
    #                       seed 5        9        15            0.24
    # rate of the repeat                0.10      0.18
    table = {(3, 0): 1, (3, 1): 3, (5, 0): 9, (5, 1): 15}
    repeats = [
        {"seed": seed, "repeat": repeat, "collisions": count, "successes": 50 - 2 * count}
        for (seed, repeat), count in table.items()
    ]
    both = cell(*repeats)
    assert both.n_seeds == 2
    assert both.deviation("collisions", "repeat") == pytest.approx(0.08 / math.sqrt(2))
    assert both.deviation("collisions", "seed") == pytest.approx(0.20 / math.sqrt(2))
    assert both.deviation("successes", "repeat") == pytest.approx(0.16 / math.sqrt(2))
    assert both.deviation("successes", "seed") == pytest.approx(0.40 / math.sqrt(2))
    one = cell(repeats[0])
    assert [one.deviation("collisions", over) for over in ("repeat", "seed")] == [None, None]


def test_cells_are_grouped_by_all_but_seed_and_repeat_in_the_order_of_appearance() -> None:
    others = [
        {"task": "MazeMedium-v0"},
        {"policy": "dppf"},
        {"guidance_integrator": "euler"},
        {"guidance_scale": 8.0},
        {"variant": "wide"},
    ]
    firsts = [SUMMARY, *(replace(SUMMARY, **other) for other in others)]
    more = [
        replace(row, **same)
        for row in firsts
        for same in ({"seed": 1}, {"repeat": 1}, {"seed": 1, "repeat": 1})
    ]
    cells = group_cells([*firsts, *more])
    assert [cell.repeats[0] for cell in cells] == firsts
    assert [len(cell.repeats) for cell in cells] == [4] * len(firsts)


# Tables


COLUMNS = [
    *("task", "policy", "guidance", "lambda", "collision rate [%]", "95 % interval", "p (McNemar)"),
    *("success rate [%]", "episodes"),
]


def markdown_rows(*cells: Cell) -> list[str]:
    head, rule, *rows = make_markdown(cells).splitlines()
    assert rule == "|" + "---|" * (head.count("|") - 1)
    assert all(row.count("|") == head.count("|") for row in rows)
    return [head, *rows]


def test_markdown_shows_mean_deviation_interval_p_and_number_of_episodes() -> None:
    unguided = cell(
        {**UNGUIDED, "collisions": 10, "successes": 50},
        {**UNGUIDED, "repeat": 1, "collisions": 10, "successes": 50},
    )
    pairs = {"only_unguided_collides": 4, "only_guided_collides": 0}
    guided = cell(
        {"collisions": 1, "successes": 49, **pairs},
        {"repeat": 1, "collisions": 3, "successes": 50, **pairs, "only_guided_collides": 1},
    )
    head, *rows = markdown_rows(unguided, guided)
    assert head == f"| {' | '.join(COLUMNS)} |"
    assert rows == [
        "| MazeLarge-v0 | fmp | none |  | 20.00 ± 0.00 | 13.34 to 28.88 |  | 100.00 ± 0.00 | 2 x 50 |",
        "| MazeLarge-v0 | pf2mp | proximal | 0.8 | 4.00 ± 2.83 | 1.57 to 9.84 | 0.039 | 99.00 ± 1.41 | 2 x 50 |",
    ]


def test_markdown_shows_plans_in_the_wall_if_an_environment_reports_them() -> None:
    reporting = cell({"plans_in_wall": 10}, {"repeat": 1, "plans_in_wall": 5})
    head, row, silent_row = markdown_rows(reporting, cell({}))
    assert "| p (McNemar) | plans in the wall [%] | success rate [%] |" in head
    assert "|  | 15.00 ± 7.07 | 98.00 ± 0.00 |" in row
    assert silent_row.endswith("|  |  | 98.00 | 50 |")


PLAN_TITLES = "plans | flagged [%] | collisions among the unflagged [%] | colliding episodes flagged [%]"
MANY = {"n_episodes": 1000, "successes": 1000, "plans_drawn": 10826, "n_plans": 10000, "collisions": 14}


def test_markdown_shows_plans_and_flagged_episodes_where_they_were_measured() -> None:
    some = cell({**MANY, "flagged": 50, "flagged_collisions": 10})
    safe = cell({**MANY, "collisions": 0, "flagged": 0, "flagged_collisions": 0})
    head, *rows = markdown_rows(some, safe, cell({}))
    assert head.endswith(f"| success rate [%] | {PLAN_TITLES} | episodes |")
    ends = [row.split(" | 100.00 | " if "100.00" in row else " | 98.00 | ")[1] for row in rows]
    assert ends == [
        "1.08 | 5.0 (3.8 to 6.5) | 0.42 (0.16 to 1.1) | 71.4 (45.4 to 88.3) | 1000 |",
        "1.08 | 0.00 (0.00 to 0.38) | 0.00 (0.00 to 0.38) |  | 1000 |",
        " |  |  |  | 50 |",
    ]


def test_columns_of_flagged_episodes_are_there_only_if_a_cell_has_something_in_them() -> None:
    silent = cell({**MEASURED, "collisions": None, "flagged_collisions": None})
    head, row = markdown_rows(silent)
    assert head.endswith("| success rate [%] | plans | flagged [%] | episodes |")
    assert row.endswith("| 98.00 | 1.50 | 20.0 (11.2 to 33.0) | 50 |")
    all_flagged = cell({**MEASURED, "flagged": 50, "flagged_collisions": 8})
    head, row = markdown_rows(all_flagged)
    assert head.endswith("| plans | flagged [%] | colliding episodes flagged [%] | episodes |")
    assert row.endswith("| 1.50 | 100.0 (92.9 to 100.0) | 100.0 (67.6 to 100.0) | 50 |")
    assert PLAN_TITLES.split(" | ")[1] not in markdown_rows(cell({}))[0]


def test_markdown_shows_the_deviation_over_training_seeds_if_there_are_several() -> None:
    seeds = cell(
        *(
            {"seed": seed, "repeat": repeat, "collisions": count, "successes": 50}
            for (seed, repeat), count in {(3, 0): 1, (3, 1): 3, (5, 0): 9, (5, 1): 15}.items()
        )
    )
    row = markdown_rows(seeds)[-1]
    assert "| 14.00 ± 5.66 (seeds ± 14.14) |" in row
    assert row.endswith("| 100.00 ± 0.00 (seeds ± 0.00) | 2 x 2 x 50 |")


@pytest.mark.parametrize(
    ("repeats", "text"),
    [
        ([(3, 0)], "50"),
        ([(3, 0), (3, 1)], "2 x 50"),
        ([(3, 0), (5, 0)], "2 x 1 x 50"),
        ([(3, 0), (3, 1), (5, 0), (5, 1)], "2 x 2 x 50"),
        ([(3, 0), (3, 1), (5, 0)], "150"),  # a repeat is missing
    ],
)
def test_episodes_are_training_seeds_times_repeats_times_pairs(
    repeats: list[tuple[int, int]], text: str
) -> None:
    row = markdown_rows(cell(*({"seed": seed, "repeat": repeat} for seed, repeat in repeats)))[-1]
    assert row.endswith(f"| {text} |")


@pytest.mark.parametrize(
    ("n_fixed", "text"), [(5, "0.062"), (14, "0.00012"), (15, "< 1e-4"), (400, "< 1e-4"), (0, "1")]
)
def test_small_p_values_are_cut_off(n_fixed: int, text: str) -> None:
    row = markdown_rows(cell({"only_unguided_collides": n_fixed, "only_guided_collides": 0}))[-1]
    assert f"| {text} |" in row


def test_what_an_environment_does_not_report_is_left_empty() -> None:
    row = markdown_rows(cell({"collisions": None}))[-1]
    assert row == "| MazeLarge-v0 | pf2mp | proximal | 0.8 |  |  |  | 98.00 | 50 |"


def test_there_is_a_column_of_variants_only_if_there_are_any() -> None:
    wide = cell({"variant": "wide"})
    head, plain_row, wide_row = markdown_rows(cell({}), wide)
    assert "| lambda | variant | collision rate [%] |" in head
    assert "| 0.8 |  | 2.00 |" in plain_row
    assert "| 0.8 | wide | 2.00 |" in wide_row
    assert "variant" not in markdown_rows(cell({}))[0]
    assert make_latex([cell({}), wide]).startswith(r"\begin{tabular}{llllllllll}")


def test_latex_is_the_same_table_with_the_rules_of_booktabs() -> None:
    pairs = {"only_unguided_collides": 30, "only_guided_collides": 0}
    repeats = [{"task": "maze_large", "repeat": repeat, "collisions": 1, **pairs} for repeat in (0, 1)]
    table = make_latex([cell(*repeats)])
    assert table.splitlines() == [
        r"\begin{tabular}{lllllllll}",
        r"\toprule",
        r"task & policy & guidance & $\lambda$ & collision rate [\%] & 95 \% interval & p (McNemar) & success rate [\%] "
        r"& episodes \\",
        r"\midrule",
        r"maze\_large & pf2mp & proximal & 0.8 & 2.00 $\pm$ 0.00 & 0.55 to 7.00 & $<$ 1e-4 & 98.00 $\pm$ 0.00 "
        r"& 2 $\times$ 50 \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]


def test_latex_shows_plans_and_flagged_episodes_too() -> None:
    table = make_latex([cell({**MANY, "flagged": 50, "flagged_collisions": 10})]).splitlines()
    assert table[0] == r"\begin{tabular}{lllllllllllll}"
    assert table[2].endswith(
        r"& success rate [\%] & plans & flagged [\%] & collisions among the unflagged [\%] "
        r"& colliding episodes flagged [\%] & episodes \\"
    )
    assert table[4].endswith(
        r"& 100.00 & 1.08 & 5.0 (3.8 to 6.5) & 0.42 (0.16 to 1.1) & 71.4 (45.4 to 88.3) & 1000 \\"
    )


@pytest.mark.parametrize(
    ("name", "escaped"),
    [
        ("a_b", r"a\_b"),
        ("50 %", r"50 \%"),
        ("big & small", r"big \& small"),
        ("#1", r"\#1"),
        ("{x}", r"\{x\}"),
    ],
)
def test_names_cannot_break_a_latex_table(name: str, escaped: str) -> None:
    row = make_latex([cell({"policy": name})]).splitlines()[4]
    assert row.startswith(f"MazeLarge-v0 & {escaped} & proximal & ")
