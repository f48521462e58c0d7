# SPDX-License-Identifier: Apache-2.0
"""Demonstrated chunks of actions, kept with the field to tell how well a plan should be supported."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from lerobot_pf2mp.density.held_out import group_numbers
from lerobot_pf2mp.density.kernels import wrap
from lerobot_pf2mp.policies.guided.frame_ranks import frame_of, rank_of
from lerobot_pf2mp.potential_field import PotentialField
from lerobot_pf2mp.potential_field.ways import way_log_density

# Largest number of episodes of which a plan is kept. The threshold for plans is a quantile of as many numbers.
N_EPISODES = 1000

# Plans of a single recording, one for each block of time that is left out where it is judged.
N_PLANS_OF_ONE_EPISODE = 100

# An action of a plan is a wrong value if it is this many times farther from all other episodes than nine in ten actions
# are, and as far, and at this many times the usual speed, from the action before or after it.
_FAR = 5.0
_USUAL_QUANTILE = 0.9
_FASTEST = 3.0
_USUAL_SPEED_QUANTILE = 0.95

# A state is where the robot is if it is this near to the first action, in parts of the actions' range.
_LARGEST_GAP = 0.25
_ROUNDING = 1e-3


class DemonstratedPlans:
    """One demonstrated plan of each of up to `N_EPISODES` episodes, drawn evenly over episodes and over their plans.

    Episodes and the first frames of plans are ranked by the same hash as the frames of a field, so the sample does not
    depend on the order in which plans are seen, or on how often. From a single episode more than one plan is kept.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Forgets all plans."""
        self.ways = torch.empty(0, 0, 0)  # (E, T + 1, D) where the robot was, then T actions [normalised]
        self.episodes = torch.empty(0, dtype=torch.int64)  # (E,)
        self.ranks = torch.empty(0, dtype=torch.int64)  # (E,) of the first frames

    def __len__(self) -> int:
        return len(self.ranks)

    @property
    def n_actions(self) -> int:
        """The number of actions T of a plan; 0 if there is none."""
        return max(self.ways.shape[1] - 1, 0)

    def restore(self, ways: Tensor, episodes: Tensor, ranks: Tensor) -> None:
        """Restores plans that were saved."""
        self.ways, self.episodes, self.ranks = ways, episodes, ranks

    def observe(self, ways: Tensor, episodes: Tensor, frames: Tensor) -> bool:
        """Adds plans of a training batch, and returns whether that changed the sample.

        Args:
            ways: ``(B, T + 1, D)`` where the robot is, then T actions [normalised]. Of plans that were kept before, this
                shape must be the same; otherwise they are forgotten.
            episodes: ``(B,)`` episode numbers.
            frames: ``(B,)`` number of each plan's first frame.
        """
        ranks = rank_of(frames)
        if len(self) and self.ways.shape[1:] != ways.shape[1:]:
            self.forget()
        if len(self):
            device = ways.device
            known = self.ways.to(device), self.episodes.to(device), self.ranks.to(device)
            may_enter = self._may_enter(known[1], known[2], episodes, ranks)
            if not bool(may_enter.any()):  # most batches of a long training
                return False
            ways, episodes, ranks = (
                torch.cat([old, new[may_enter]])
                for old, new in zip(known, (ways, episodes, ranks), strict=True)
            )
        order = _chosen(episodes, ranks)
        self.restore(ways[order], episodes[order], ranks[order])
        return True

    @staticmethod
    def _may_enter(known_episodes: Tensor, known_ranks: Tensor, episodes: Tensor, ranks: Tensor) -> Tensor:
        """Whether plans come before one that is kept, or there is room for them, ``(B,)`` bool."""
        known, new = rank_of(known_episodes), rank_of(episodes)  # the known ones ascend
        # Of a single episode that is kept, the last plan is the one to come before.
        place = torch.searchsorted(known, new, right=True) - 1
        is_known = (place >= 0) & (known[place] == new)
        is_better = ranks < known_ranks[place]
        has_room = (new < known[-1]) | (len(known) < N_EPISODES)
        is_full = len(known) >= N_PLANS_OF_ONE_EPISODE
        return torch.where(is_known & ((known[0] != known[-1]) | is_full), is_better, has_room)

    def scores(
        self,
        field: PotentialField,
        episodes: Tensor | None,
        frames: Tensor,
        n_actions: int,
        *,
        starts_at_state: bool,
    ) -> Tensor:
        """The support of each plan's way over the anchors of other episodes: what a fresh demonstration would have.

        Plans with a wrong value of a sensor do not count: an action that is far from all anchors of other episodes, and
        to which and from which the way jumps. A way that no other episode went has no such jumps, and counts.

        Args:
            field: The potential field.
            episodes: ``(M,)`` the anchors' episodes; None if the field judges its own actions, as the paper's does.
            frames: ``(M,)`` the anchors' frames.
            n_actions: Number of actions K of a plan that are executed, at most T.
            starts_at_state: Whether ways begin at the observed state. Otherwise they begin at the first action.

        Returns:
            ``(n,)`` smallest log densities [nats]; of at most one plan for each episode, or block of time.
        """
        ways = self.ways.cpu()[:, : n_actions + 1].clone()
        if not starts_at_state:
            ways[:, 0] = ways[:, 1]
        periods = None if field.periods is None else field.periods.cpu()
        if episodes is None:
            density = way_log_density(
                lambda points, _: field.log_density(points),
                ways.to(field.anchors.device),
                field.bandwidth,
                field.periods,
            )
            return density.amin(dim=1).cpu()
        first = frame_of(self.ranks.cpu()).unsqueeze(1)
        of_plans = (first + torch.arange(n_actions)).flatten()  # (E K,) frames
        both = torch.cat([episodes, self.episodes.cpu().repeat_interleave(n_actions)])
        groups = group_numbers(len(both), both, torch.cat([frames, of_plans]))
        of_anchors, of_pieces = groups.split([len(episodes), len(of_plans)])
        judge = partial(field.to("cpu").without_own_group, groups_of_anchors=of_anchors)
        density = way_log_density(
            lambda points, piece: judge(points, of_pieces[piece])[0],
            ways,
            field.bandwidth,
            periods,
        )  # (E, K)
        is_judged = density.isfinite().all(dim=1) & ~_has_wrong_value(judge, of_pieces, ways, field)
        middles = of_pieces.view(len(self), -1)[:, n_actions // 2]
        return self._one_each(density.amin(dim=1)[is_judged], middles[is_judged]).float()

    @staticmethod
    def _one_each(scores: Tensor, groups: Tensor) -> Tensor:
        """The first score of each group."""
        _, number = torch.unique(groups, return_inverse=True)
        first = torch.full((int(number.max()) + 1 if len(number) else 0,), len(number))
        first = first.scatter_reduce(0, number, torch.arange(len(number)), "amin")
        return scores[first.sort().values]


def choose_plans_of_episodes(episodes: Tensor, frames: Tensor, drop_n_last_frames: int) -> Tensor:
    """The frames with which the plans begin that `DemonstratedPlans` would keep of a whole dataset.

    Args:
        episodes: ``(N,)`` episode numbers of all frames, in order.
        frames: ``(N,)`` their indices in the dataset.
        drop_n_last_frames: Number of an episode's last frames with which no chunk begins in training.

    Returns:
        ``(E,)`` positions among the N.
    """
    _, number, counts = torch.unique_consecutive(episodes, return_inverse=True, return_counts=True)
    n_left = counts.cumsum(0)[number] - torch.arange(len(episodes))
    is_start = n_left > drop_n_last_frames
    starts = is_start.nonzero().squeeze(1)
    return starts[_chosen(episodes[starts], rank_of(frames[starts]))]


def _chosen(episodes: Tensor, ranks: Tensor) -> Tensor:
    """The plans to keep, in the order of their episodes' ranks, then of their own."""
    order = ranks.argsort()
    order = order[rank_of(episodes[order]).argsort(stable=True)]
    episode, rank = episodes[order], ranks[order]
    is_new = torch.ones_like(rank, dtype=torch.bool)
    is_new[1:] = rank[1:] != rank[:-1]
    order, episode = order[is_new], episode[is_new]
    is_first = torch.ones_like(episode, dtype=torch.bool)
    is_first[1:] = episode[1:] != episode[:-1]
    if int(is_first.sum()) <= 1:
        return order[:N_PLANS_OF_ONE_EPISODE]
    return order[is_first][:N_EPISODES]


def _has_wrong_value(
    judge: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
    groups: Tensor,
    ways: Tensor,
    field: PotentialField,
) -> Tensor:
    """Whether an action of a plan is far from all other episodes, and from its neighbours in the plan, ``(E,)``."""
    actions = ways[:, 1:]  # (E, K, D)
    distance = judge(actions.flatten(0, 1), groups)[1].view(len(ways), -1)
    known = distance[distance.isfinite()]
    if not len(known):
        return torch.zeros(len(ways), dtype=torch.bool)
    limit = _FAR * max(known.quantile(_USUAL_QUANTILE).item(), field.bandwidth)
    steps = actions.diff(dim=1)
    if field.periods is not None:
        steps = wrap(steps, field.periods.cpu())
    speeds = steps.norm(dim=-1)  # (E, K - 1)
    if not speeds.numel():
        return torch.zeros(len(ways), dtype=torch.bool)
    is_jump = speeds > max(limit, _FASTEST * speeds.quantile(_USUAL_SPEED_QUANTILE).item())
    edge = is_jump.new_zeros(len(ways), 1)
    beside_jump = torch.cat([edge, is_jump], dim=1) | torch.cat([is_jump, edge], dim=1)
    return ((distance > limit) & beside_jump).any(dim=1)


def states_are_places(ways: Tensor, periods: Tensor | None = None) -> bool:
    """Whether observed states are where the robot is, in the units of its actions.

    In each dimension, the median of their distance to the first action must be at most `_LARGEST_GAP` of the range of the
    actions.

    Args:
        ways: ``(E, T + 1, D)`` observed states, then actions [normalised].
        periods: ``(D,)`` periods of angles [normalised], 0 for other dimensions; None if there are no angles.
    """
    steps = ways[:, 1] - ways[:, 0]
    if periods is not None:
        steps = wrap(steps, periods)
    gaps = steps.abs().median(dim=0).values  # (D,)
    ordered = ways[:, 1:].flatten(0, 1).sort(dim=0).values
    low, high = (ordered[round(share * (len(ordered) - 1))] for share in (0.05, 0.95))
    return bool((gaps <= _LARGEST_GAP * (high - low) + _ROUNDING).all())
