# SPDX-License-Identifier: Apache-2.0
"""The harness of the speed benchmarks."""

import time
from pathlib import Path

import density
import pytest
import torch
from harness import Row, growth_exponent, ratio, time_in_turns
from report import make_overview, make_table, read_rows, write_report

BENCH = Path(__file__).parents[1] / "results" / "bench"


def test_calls_are_timed_in_turns_that_begin_with_another_one_each_round() -> None:
    turns: list[str] = []

    def call(name: str, seconds: float) -> None:
        turns.append(name)
        time.sleep(seconds)

    times = time_in_turns({"a": lambda: call("a", 0.002), "b": lambda: call("b", 0.004)}, 4, min_seconds=0.0)
    assert "".join(turns[-8:]) == "abbaabba"
    assert 1.3 < ratio(times, "b", "a") < 3
    assert ratio(times, "a", "a") == 1


def test_a_turn_repeats_a_fast_call() -> None:
    calls: list[int] = []
    (seconds,) = time_in_turns({"a": lambda: calls.append(1)}, 1, min_seconds=0.01)["a"]
    assert len(calls) > 1000
    assert seconds < 1e-4


def test_the_exponent_is_that_of_the_power_law() -> None:
    assert growth_exponent([1, 10, 100], [3, 3 * 10**1.5, 3 * 10**3]) == pytest.approx(1.5)


@pytest.mark.parametrize(("n_queries", "enough"), [(80, 1.0), (10_000, 1.0), (1_000_000, 0.06)])
def test_a_slow_density_is_timed_with_as_many_queries_as_there_is_time_for(
    n_queries: int, enough: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]  # of a machine on which a query takes 10 microseconds, whatever else runs

    def evaluate(queries: torch.Tensor) -> None:
        clock[0] += 1e-5 * len(queries)

    case = density.Case(torch.zeros(3, 2), torch.zeros(n_queries, 2), 0.1)
    wanted = n_queries if enough == 1.0 else 1000
    with monkeypatch.context() as patch:
        patch.setattr(time, "perf_counter", lambda: clock[0])
        n, seconds = density._queries_within(enough, evaluate, case)
    assert n == wanted
    assert seconds == pytest.approx(1e-5 * n)


@pytest.mark.parametrize(
    ("target", "at_least", "verdict"),
    [
        (None, False, ""),
        (2.0, False, "met"),
        (1.9, False, "missed"),
        (2.0, True, "met"),
        (2.1, True, "missed"),
    ],
)
def test_verdicts(target: float | None, at_least: bool, verdict: str) -> None:
    assert Row("p", "c", "q", 2.0, "x", target=target, at_least=at_least).verdict == verdict


def test_parts_measured_before_stay_until_they_are_measured_again(tmp_path: Path) -> None:
    old = [Row("a", "c", "q", 1.0, "x", 2, target=3.0), Row("b", "c", "q", 2.0, "ms")]
    write_report(tmp_path, old)
    new = Row("b", "c", "q", 4.0, "ms", 0, 5.0, True)
    assert write_report(tmp_path, [new]) == [old[0], new]
    assert read_rows(tmp_path / "bench.csv") == [old[0], new]


def test_the_overview_has_the_worst_and_the_best_case_and_counts_those_that_met_the_target() -> None:
    rows = [Row("a", str(value), "q", value, "x", target=2.0) for value in (1.5, 3.0, 1.0)]
    rows.append(Row("b", "c", "q", 12.0, "frames/s", target=10.0, at_least=True))
    assert make_overview(rows).splitlines()[2:] == [
        "| a | q | ≤ 2 | 1 | 3 | 2 of 3 |",
        "| b | q | ≥ 10 frames/s | 12 frames/s | 12 frames/s | 1 of 1 |",
    ]


def test_published_tables_are_made_from_the_rows_beside_them() -> None:
    rows = read_rows(BENCH / "bench.csv")
    wished = [row for row in rows if row.target is not None]
    assert (BENCH / "table.md").read_text(encoding="utf-8") == make_table(wished)
    assert (BENCH / "overview.md").read_text(encoding="utf-8") == make_overview(rows)
