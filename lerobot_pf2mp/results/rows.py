# SPDX-License-Identifier: Apache-2.0
"""Rows of a benchmark's results, for each episode and for each repeat, and their CSV files."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_pf2mp.process.atomic_files import file_written_beside

NO_GUIDANCE = "none"


# Of whole numbers.
_MOST_DIGITS = 15


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
        success: Whether the goal was reached, with or without collisions.
        collision: Whether there was a collision.
        plan_in_wall: Whether an action lay inside an obstacle. The robot's body may collide without this.
        min_clearance_m: Smallest distance to an obstacle during the episode [m], negative inside.
        path_length_m: Length of the executed path [m].
        stroke_error_mm: Mean distance of the drawn line to the letter [mm].
        steps: Control steps.
        chunk_latency_ms: Time to generate one chunk for one robot [ms]: the median over several calls, measured once for
            each policy, kind of guidance and repeat.
        checkpoint: Folder or repository from which the policy was loaded.
        commit: Commit of this package; empty if unknown.
        plans_drawn: Plans that the policy drew in the episode; None, as for the next two, if they were not measured.
        n_plans: Plans (chunks) of which actions were executed.
        plan_flagged: Whether one of those still left the demonstrated region.
        obstacle_collision: Whether there was a collision with an obstacle that the demonstrations did not have; None
            without such obstacles.
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
    # Files of before have no columns for what has a default.
    plans_drawn: int | None = None
    n_plans: int | None = None
    plan_flagged: bool | None = None
    obstacle_collision: bool | None = None


@dataclass(frozen=True)
class SummaryRow:
    """The counts of one repeat of one policy with one kind of guidance.

    Args:
        task: The environment's task.
        policy: Name of the policy.
        guidance_integrator: proximal or euler; none for an unguided policy.
        guidance_scale: lambda.
        variant: Name of the changes made to the checkpoint's configuration.
        seed: Seed of the policy's training.
        repeat: Number of the repeat.
        n_episodes: Number of episodes.
        successes: Episodes that reached the goal.
        collisions: Episodes with a collision; None if the environment does not report them.
        plans_in_wall: Episodes with an action inside an obstacle; None if the environment does not report it.
        only_unguided_collides: Episodes that collide without guidance and not with guidance; None if there are no results
            without guidance.
        only_guided_collides: Episodes that collide with guidance and not without; None in the same case.
        min_clearance_m: Mean over episodes [m].
        path_length_m: Mean over episodes [m].
        stroke_error_mm: Mean over episodes [mm].
        chunk_latency_ms: Time to generate one chunk [ms].
        checkpoint: Folder or repository from which the policy was loaded.
        commit: Commit of this package.
        plans_drawn: Plans drawn in all episodes; None, as for the next three, if they were not measured.
        n_plans: Plans executed in all episodes.
        flagged: Episodes in which a plan was executed that left the demonstrated region.
        flagged_collisions: Those of them with a collision; None also if the environment does not report them.
        obstacle_collisions: Episodes with a collision with an obstacle that the demonstrations did not have; None without
            such obstacles.
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
    # As above.
    plans_drawn: int | None = None
    n_plans: int | None = None
    flagged: int | None = None
    flagged_collisions: int | None = None
    obstacle_collisions: int | None = None


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
    """Reads rows from CSV, leaving out a last line that was cut off. Columns that the file does not have yet are None.

    Args:
        path: The file.
        row_type: `EpisodeRow` or `SummaryRow`.

    Raises:
        ValueError: If the file's columns are not those of the row, or a value is of the wrong kind.
    """
    fields = {field.name: str(field.type) for field in dataclasses.fields(row_type)}  # type: ignore[arg-type]
    added = [
        field.name
        for field in dataclasses.fields(row_type)  # type: ignore[arg-type]
        if field.default is not dataclasses.MISSING
    ]
    text = path.read_text(encoding="utf-8")
    whole_lines = text[: text.rfind("\n") + 1].splitlines()
    reader = csv.DictReader(whole_lines)
    columns = list(reader.fieldnames or [])
    if columns != [name for name in fields if name in columns or name not in added]:
        required = [name for name in fields if name not in added]
        raise ValueError(f"{path} must have the columns {required}, and may have {added}, got {columns}")
    fields = {name: fields[name] for name in columns}
    try:
        return [_parse_row(line, fields, row_type) for line in reader]
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path} must hold one result on each line: {error}") from error


def _parse_row[Row](line: dict[str, str], fields: dict[str, str], row_type: type[Row]) -> Row:
    values = list(line.values())
    if None in line or None in values:  # DictReader's markers for too many and too few values
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
    if kind == "int" and len(text) > _MOST_DIGITS:
        raise ValueError(f"numbers must have at most {_MOST_DIGITS} digits, got {text[:40]}")
    return {"int": int, "float": float, "str": str}[kind](text)
