# SPDX-License-Identifier: Apache-2.0
"""Results of a benchmark: one row for each episode, and what is counted from them."""

from __future__ import annotations

import csv
import dataclasses
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from scipy.stats import binomtest

from lerobot_pf2mp.process.atomic_files import file_written_beside
from lerobot_pf2mp.results.rate import Rate

NO_GUIDANCE = "none"


@dataclass(frozen=True)
class EpisodeRow:
    """The outcome of one episode. Numbers that an environment does not report are None.

    Args:
        task: The environment's task.
        policy: Name of the policy.
        guidance_integrator: proximal or euler; none for an unguided policy.
        guidance_scale: lambda; 0 without guidance.
        variant: Name of the changes made to the checkpoint's configuration; empty for none.
        seed: Seed of the policy's training.
        repeat: Number of the repeat, which seeds the prior noise.
        episode: Number of the start-goal pair.
        success: Whether the goal was reached, irrespective of collisions.
        collision: Whether there was a collision.
        plan_in_wall: Whether an action lay inside an obstacle, which says nothing about the robot around it.
        min_clearance_m: Smallest distance to an obstacle on the way [m], negative inside.
        path_length_m: Length of the way [m].
        stroke_error_mm: Mean distance of what was drawn to what should have been [mm].
        steps: Control steps.
        chunk_latency_ms: Time to plan one chunk for one robot [ms]: the median over several calls, measured once for
            each policy, kind of guidance and repeat.
        checkpoint: Where the policy was loaded from.
        commit: Commit of this package; empty if unknown.
    """

    task: str
    policy: str
    guidance_integrator: str
    guidance_scale: float
    variant: str
    seed: int
    repeat: int
    episode: int
    success: bool
    collision: bool | None
    plan_in_wall: bool | None
    min_clearance_m: float | None
    path_length_m: float | None
    stroke_error_mm: float | None
    steps: int | None
    chunk_latency_ms: float | None
    checkpoint: str
    commit: str


@dataclass(frozen=True)
class SummaryRow:
    """What is counted of one repeat of one policy with one kind of guidance.

    Args:
        task: The environment's task.
        policy: Name of the policy.
        guidance_integrator: proximal or euler; none for an unguided policy.
        guidance_scale: lambda.
        variant: Name of the changes made to the checkpoint's configuration.
        seed: Seed of the policy's training.
        repeat: Number of the repeat.
        n_episodes: Episodes.
        successes: Episodes that reached the goal.
        collisions: Episodes with a collision; None if the environment does not report them.
        plans_in_wall: Episodes with an action inside an obstacle; None if the environment does not report it.
        only_unguided_collides: Episodes in which the unguided twin collides and this one does not; None without a twin.
        only_guided_collides: Episodes in which this one collides and its twin does not; None without a twin.
        min_clearance_m: Mean over episodes [m].
        path_length_m: Mean over episodes [m].
        stroke_error_mm: Mean over episodes [mm].
        chunk_latency_ms: Time to plan one chunk [ms].
        checkpoint: Where the policy was loaded from.
        commit: Commit of this package.
    """

    task: str
    policy: str
    guidance_integrator: str
    guidance_scale: float
    variant: str
    seed: int
    repeat: int
    n_episodes: int
    successes: int
    collisions: int | None
    plans_in_wall: int | None
    only_unguided_collides: int | None
    only_guided_collides: int | None
    min_clearance_m: float | None
    path_length_m: float | None
    stroke_error_mm: float | None
    chunk_latency_ms: float | None
    checkpoint: str
    commit: str


def summarise(rows: Iterable[EpisodeRow]) -> list[SummaryRow]:
    """Counts the episodes of every repeat and pairs each guided one with its unguided twin.

    The twin is the same checkpoint and variant without guidance, on the same start-goal pairs and prior noise.

    Args:
        rows: Episodes.
    """
    repeats: dict[tuple[object, ...], list[EpisodeRow]] = {}
    for row in rows:
        repeats.setdefault(_repeat_of(row), []).append(row)
    unguided = {
        (*_twin_of(row), row.episode): row.collision
        for episodes in repeats.values()
        for row in episodes
        if row.guidance_scale == 0
    }
    return [_summarise_repeat(episodes, unguided) for episodes in repeats.values()]


def _repeat_of(row: EpisodeRow) -> tuple[object, ...]:
    guidance = row.guidance_integrator, row.guidance_scale
    return row.task, row.policy, *guidance, row.variant, row.seed, row.repeat, row.checkpoint


def _twin_of(row: EpisodeRow) -> tuple[object, ...]:
    return row.task, row.variant, row.seed, row.repeat, row.checkpoint


def _summarise_repeat(
    episodes: list[EpisodeRow], unguided: dict[tuple[object, ...], bool | None]
) -> SummaryRow:
    first = episodes[0]
    twins = [unguided.get((*_twin_of(row), row.episode)) for row in episodes]
    pairs = [(row.collision, twin) for row, twin in zip(episodes, twins, strict=True)]
    is_paired = first.guidance_scale > 0 and all(None not in pair for pair in pairs)
    return SummaryRow(
        task=first.task,
        policy=first.policy,
        guidance_integrator=first.guidance_integrator,
        guidance_scale=first.guidance_scale,
        variant=first.variant,
        seed=first.seed,
        repeat=first.repeat,
        n_episodes=len(episodes),
        successes=sum(row.success for row in episodes),
        collisions=_count_or_none([row.collision for row in episodes]),
        plans_in_wall=_count_or_none([row.plan_in_wall for row in episodes]),
        only_unguided_collides=sum(pair == (False, True) for pair in pairs) if is_paired else None,
        only_guided_collides=sum(pair == (True, False) for pair in pairs) if is_paired else None,
        min_clearance_m=_mean_or_none([row.min_clearance_m for row in episodes]),
        path_length_m=_mean_or_none([row.path_length_m for row in episodes]),
        stroke_error_mm=_mean_or_none([row.stroke_error_mm for row in episodes]),
        chunk_latency_ms=first.chunk_latency_ms,
        checkpoint=first.checkpoint,
        commit=first.commit,
    )


def _count_or_none(values: Sequence[bool | None]) -> int | None:
    return None if values[0] is None else sum(map(bool, values))


def _mean_or_none(values: Sequence[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return round(statistics.fmean(present), 6) if present else None


@dataclass(frozen=True)
class Cell:
    """All repeats and training seeds of one policy with one kind of guidance on one task.

    Args:
        repeats: The repeats, at least one.
    """

    repeats: tuple[SummaryRow, ...]

    @property
    def n_episodes(self) -> int:
        """All episodes."""
        return sum(row.n_episodes for row in self.repeats)

    @property
    def n_seeds(self) -> int:
        """Training seeds."""
        return len({row.seed for row in self.repeats})

    @property
    def collision(self) -> Rate | None:
        """How many of all episodes collide; None if the environment does not report it."""
        return self._rate_if_reported([row.collisions for row in self.repeats])

    @property
    def plan_in_wall(self) -> Rate | None:
        """In how many of all episodes an action lies inside an obstacle; None if the environment does not report it."""
        return self._rate_if_reported([row.plans_in_wall for row in self.repeats])

    @property
    def success(self) -> Rate:
        """How many of all episodes reach the goal."""
        return Rate(sum(row.successes for row in self.repeats), self.n_episodes)

    @property
    def stroke_error(self) -> float | None:
        """Mean over all episodes [mm]; None if the environment does not report it."""
        sums = [
            row.n_episodes * row.stroke_error_mm for row in self.repeats if row.stroke_error_mm is not None
        ]
        return sum(sums) / self.n_episodes if sums else None

    def deviation(self, count: str, over: str) -> float | None:
        """Standard deviation of a rate over repeats or training seeds; None if there is only one.

        Args:
            count: collisions, plans_in_wall or successes.
            over: repeat or seed; the other one is averaged over.
        """
        groups: dict[int, list[SummaryRow]] = {}
        for row in self.repeats:
            groups.setdefault(getattr(row, over), []).append(row)
        rates = [
            sum(getattr(row, count) or 0 for row in rows) / sum(row.n_episodes for row in rows)
            for rows in groups.values()
        ]
        return statistics.stdev(rates) if len(rates) > 1 else None

    def _rate_if_reported(self, counts: Sequence[int | None]) -> Rate | None:
        reported = [count for count in counts if count is not None]
        return Rate(sum(reported), self.n_episodes) if reported else None

    @property
    def mcnemar_p(self) -> float | None:
        """Two-sided p-value of McNemar's exact test against the unguided twin; None without one.

        The null hypothesis is that guidance turns as many clear episodes into collisions as the other way round
        (McNemar, 1947).
        """
        fixed = [row.only_unguided_collides for row in self.repeats if row.only_unguided_collides is not None]
        broken = [row.only_guided_collides for row in self.repeats if row.only_guided_collides is not None]
        if not fixed:
            return None
        n = sum(fixed) + sum(broken)
        return binomtest(sum(fixed), n).pvalue if n else 1.0


def group_cells(rows: Iterable[SummaryRow]) -> list[Cell]:
    """The repeats grouped by task, policy, guidance and variant, in the order of their first appearance."""
    cells: dict[tuple[object, ...], list[SummaryRow]] = {}
    for row in rows:
        key = row.task, row.policy, row.guidance_integrator, row.guidance_scale, row.variant
        cells.setdefault(key, []).append(row)
    return [Cell(tuple(repeats)) for repeats in cells.values()]


def write_rows(path: Path, rows: Sequence[EpisodeRow] | Sequence[SummaryRow], row_type: type) -> None:
    """Writes rows as CSV; the file appears whole or not at all."""
    with file_written_beside(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(field.name for field in dataclasses.fields(row_type))
        writer.writerows(format_row(row) for row in rows)


def format_row(row: EpisodeRow | SummaryRow) -> list[str]:
    """The row's values as CSV fields."""
    return [_format(getattr(row, field.name)) for field in dataclasses.fields(row)]


def read_rows[Row](path: Path, row_type: type[Row]) -> list[Row]:
    """Reads rows from CSV, leaving out a last line that was cut off.

    Args:
        path: The file.
        row_type: `EpisodeRow` or `SummaryRow`.

    Raises:
        ValueError: If the file's columns are not those of the row, or a value is of the wrong kind.
    """
    fields = {field.name: str(field.type) for field in dataclasses.fields(row_type)}  # type: ignore[arg-type]
    text = path.read_text(encoding="utf-8")
    whole_lines = text[: text.rfind("\n") + 1].splitlines()
    reader = csv.DictReader(whole_lines)
    if list(reader.fieldnames or []) != list(fields):
        raise ValueError(f"{path} must have the columns {list(fields)}, got {list(reader.fieldnames or [])}")
    try:
        return [_parse_row(line, fields, row_type) for line in reader]
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path} must hold one result on each line: {error}") from error


def _parse_row[Row](line: dict[str, str], fields: dict[str, str], row_type: type[Row]) -> Row:
    values = list(line.values())
    if None in line or None in values:  # DictReader's marks for too many and too few values
        raise ValueError(f"a line must have {len(fields)} values, got {values}")
    return row_type(**{name: _parse(line[name], kind) for name, kind in fields.items()})


def _format(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(int(value))
    return repr(value) if isinstance(value, float) else str(value)


def _parse(text: str, kind: str) -> object:
    if kind.endswith("| None") and text == "":
        return None
    kind = kind.removesuffix(" | None")
    if kind == "bool":
        return bool(int(text))
    return {"int": int, "float": float, "str": str}[kind](text)
