# SPDX-License-Identifier: Apache-2.0
"""What is counted from the episodes of a benchmark."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from scipy.stats import binomtest

from lerobot_pf2mp.results.rate import Rate
from lerobot_pf2mp.results.rows import EpisodeRow, SummaryRow


def summarise(rows: Iterable[EpisodeRow]) -> list[SummaryRow]:
    """Counts the episodes of every repeat, and pairs each guided episode with its unguided twin.

    The twin is the episode of the same checkpoint and variant without guidance, with the same start-goal pair and prior
    noise.

    Args:
        rows: The episodes.
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
        plans_drawn=_sum_or_none([row.plans_drawn for row in episodes]),
        n_plans=_sum_or_none([row.n_plans for row in episodes]),
        flagged=_count_or_none([row.plan_flagged for row in episodes]),
        flagged_collisions=_count_or_none([_is_flagged_collision(row) for row in episodes]),
        obstacle_collisions=_count_or_none([row.obstacle_collision for row in episodes]),
    )


def _is_flagged_collision(row: EpisodeRow) -> bool | None:
    return None if row.collision is None or row.plan_flagged is None else row.collision and row.plan_flagged


def _sum_or_none(values: Sequence[int | None]) -> int | None:
    present = [value for value in values if value is not None]
    return sum(present) if present else None


def _count_or_none(values: Sequence[bool | None]) -> int | None:
    return None if values[0] is None else sum(map(bool, values))


def _mean_or_none(values: Sequence[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return round(statistics.fmean(present), 6) if present else None


def _rate_or_none(count: int, total: int) -> Rate | None:
    return Rate(count, total) if total else None


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
        """The rate of episodes with a collision; None if the environment does not report it."""
        return self._rate_if_reported([row.collisions for row in self.repeats])

    @property
    def obstacle_collision(self) -> Rate | None:
        """The rate of episodes that hit an obstacle which the demonstrations did not have; None without such obstacles."""
        return self._rate_if_reported([row.obstacle_collisions for row in self.repeats])

    @property
    def plan_in_wall(self) -> Rate | None:
        """The rate of episodes with an action inside an obstacle; None if the environment does not report it."""
        return self._rate_if_reported([row.plans_in_wall for row in self.repeats])

    @property
    def flagged(self) -> Rate | None:
        """The rate of episodes with a flagged plan, among those whose plans were measured; None if there are none."""
        measured = [row for row in self.repeats if row.flagged is not None]
        return _rate_or_none(
            sum(row.flagged or 0 for row in measured), sum(row.n_episodes for row in measured)
        )

    @property
    def unflagged_collision(self) -> Rate | None:
        """The rate of collisions among the episodes without a flagged plan; None if there are none or it is unknown."""
        return _rate_or_none(
            sum(collisions - both for _, collisions, _, both in self._flagged_and_colliding),
            sum(n_episodes - flagged for n_episodes, _, flagged, _ in self._flagged_and_colliding),
        )

    @property
    def collision_flagged(self) -> Rate | None:
        """The rate of colliding episodes that had a flagged plan (recall); None if there are none or it is unknown."""
        return _rate_or_none(
            sum(both for *_, both in self._flagged_and_colliding),
            sum(collisions for _, collisions, _, _ in self._flagged_and_colliding),
        )

    @property
    def plans_drawn_each(self) -> float | None:
        """The mean number of plans drawn for each one that is executed; None if it was not measured."""
        measured = [(row.plans_drawn, row.n_plans) for row in self.repeats if row.plans_drawn is not None]
        n_plans = sum(n_plans or 0 for _, n_plans in measured)
        return sum(drawn for drawn, _ in measured) / n_plans if n_plans else None

    @property
    def success(self) -> Rate:
        """The rate of episodes that reach the goal."""
        return Rate(sum(row.successes for row in self.repeats), self.n_episodes)

    @property
    def stroke_error(self) -> float | None:
        """The mean stroke error over all episodes [mm]; None if the environment does not report it."""
        sums = [
            row.n_episodes * row.stroke_error_mm for row in self.repeats if row.stroke_error_mm is not None
        ]
        return sum(sums) / self.n_episodes if sums else None

    def deviation(self, count: str, over: str) -> float | None:
        """The standard deviation of a rate over repeats or training seeds; None if there is only one.

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
    def _flagged_and_colliding(self) -> list[tuple[int, int, int, int]]:
        """Episodes, those that collide, that are flagged, and both, of each repeat in which they are known."""
        return [
            (row.n_episodes, row.collisions, row.flagged, row.flagged_collisions)
            for row in self.repeats
            if row.collisions is not None and row.flagged is not None and row.flagged_collisions is not None
        ]

    @property
    def mcnemar_p(self) -> float | None:
        """Two-sided p-value of McNemar's exact test against the unguided twin; None without one.

        The null hypothesis is that guidance turns as many clear episodes into collisions as collisions into clear episodes
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
