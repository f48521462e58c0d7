# SPDX-License-Identifier: Apache-2.0
"""A uniform sample of the frames of a dataset, with their actions."""

from __future__ import annotations

import torch
from torch import Tensor

from lerobot_pf2mp.policies.guided.frame_ranks import frame_of, rank_of

# Frame numbers are below this. Of the actions of a chunk that are points of their own, though their frame has others in
# other chunks, the number counts this often how far the action lies in its chunk.
_IN_CHUNK = 2**40

# Largest difference of an action that is read again, relative to 1 and to the action, that is rounding.
_SAME_ACTION = 1e-4


class ActionSample:
    """The first frames in the order of their ranks, a hash of their index in the dataset.

    So the sample is uniform over the distinct frames seen so far. It does not depend on how often or in which order they
    were seen, and it needs no random state.

    Args:
        ranks: ``(P,)`` int64 ranks of the frames, ascending.
        points: ``(P, D)`` their actions [normalised].
        episodes: ``(P,)`` int64 their episode numbers, -1 if unknown.
        n_shown: Number of actions seen that had no frame number.
    """

    def __init__(
        self,
        ranks: Tensor | None = None,
        points: Tensor | None = None,
        episodes: Tensor | None = None,
        n_shown: int = 0,
    ) -> None:
        self.ranks = torch.empty(0, dtype=torch.int64) if ranks is None else ranks
        self.points = torch.empty(0, 0) if points is None else points
        self.episodes = torch.empty(0, dtype=torch.int64) if episodes is None else episodes
        self.n_shown = n_shown

    def __len__(self) -> int:
        return len(self.ranks)

    @property
    def known_episodes(self) -> Tensor | None:
        """``(P,)`` int64 episode numbers of the frames; None if any is unknown."""
        return self.episodes.cpu() if len(self) and bool((self.episodes >= 0).all()) else None

    @property
    def frames(self) -> Tensor:
        """``(P,)`` int64 indices in the dataset of the frames of the actions."""
        return frame_of(self.ranks.cpu()) % _IN_CHUNK

    def candidates(
        self,
        actions: Tensor,
        is_pad: Tensor | None,
        frames: Tensor | None,
        episodes: Tensor | None,
        n_points: int,
    ) -> ActionSample:
        """The actions of chunks that may enter a sample of `n_points`, not in order.

        The other arguments are those of `DemonstratedActions.observe`.
        """
        steps = torch.arange(actions.shape[1], device=actions.device)
        if frames is None:
            frames = self.n_shown + actions.shape[1] * torch.arange(len(actions), device=actions.device)
            self.n_shown += actions.shape[0] * actions.shape[1]
        ranks = rank_of(frames.to(actions.device).reshape(-1, 1) + steps)  # (B, T)
        if episodes is None:
            episodes = torch.full((len(actions),), -1)
        episodes = episodes.to(actions.device).reshape(-1, 1).expand_as(ranks)
        keep = torch.ones_like(ranks, dtype=torch.bool) if is_pad is None else ~is_pad
        if len(self) >= n_points:
            keep = keep & (ranks <= self.ranks[n_points - 1].to(ranks.device))
        return ActionSample(ranks[keep], actions[keep], episodes[keep])

    @staticmethod
    def each_by_itself(
        actions: Tensor, is_pad: Tensor | None, frames: Tensor | None, episodes: Tensor | None
    ) -> tuple[Tensor, Tensor | None, Tensor | None, Tensor | None]:
        """The actions of chunks as chunks of one action, with numbers by which a frame has one point for each chunk.

        Integrated actions depend on where their chunk begins. Arguments as for `DemonstratedActions.observe`.
        """
        n_steps = actions.shape[1]
        steps = torch.arange(n_steps, device=actions.device)
        return (
            actions.flatten(0, 1).unsqueeze(1),
            None if is_pad is None else is_pad.flatten().unsqueeze(1),
            None
            if frames is None
            else (frames.to(actions.device).reshape(-1, 1) + steps * (1 + _IN_CHUNK)).flatten(),
            None if episodes is None else episodes.reshape(-1).repeat_interleave(n_steps),
        )

    def contradicts(self, other: ActionSample) -> bool:
        """Whether some frames of both have other actions."""
        if not len(self) or not len(other):
            return False
        place, is_known = self._find(other.ranks)
        difference = (self.points.to(other.points.device)[place] - other.points).abs()
        is_other = (difference > _SAME_ACTION * (1 + other.points.abs())).any(dim=-1)
        return bool((is_known & is_other).any())

    def merge(self, other: ActionSample, n_points: int) -> bool:
        """Adds another sample, keeps the first `n_points`, and returns whether that changed anything.

        Args:
            other: Frames in any order, with the same actions for frames that both have.
            n_points: Number of frames to keep.

        Raises:
            ValueError: If an action is not finite.
        """
        if not len(other):
            return False
        ranks, points, episodes = other.ranks, other.points, other.episodes
        if not torch.isfinite(points).all():
            raise ValueError(
                "demonstrated actions must be finite, got NaN or infinite values in the training batch"
            )
        if len(self):
            if len(self) <= n_points and bool(self._find(ranks)[1].all()):
                return False
            ranks = torch.cat([ranks, self.ranks.to(ranks.device)])
            points = torch.cat([points, self.points.to(points.device)])
            episodes = torch.cat([episodes, self.episodes.to(episodes.device)])
        ranks, order = ranks.sort(stable=True)
        is_first = torch.ones_like(ranks, dtype=torch.bool)
        is_first[1:] = ranks[1:] != ranks[:-1]  # the hash is one to one: an equal rank is the same frame
        self.ranks = ranks[is_first][:n_points]
        self.points = points[order][is_first][:n_points]
        self.episodes = episodes[order][is_first][:n_points]
        return True

    def _find(self, ranks: Tensor) -> tuple[Tensor, Tensor]:
        """Where frames are in this sample, and whether they are, ``(Q,)`` each."""
        known = self.ranks.to(ranks.device)
        place = torch.searchsorted(known, ranks).clamp_max(len(known) - 1)
        return place, known[place] == ranks
