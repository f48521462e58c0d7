# SPDX-License-Identifier: Apache-2.0
"""The demonstrated actions on which a policy is trained, and the potential field fitted to them."""

from __future__ import annotations

import logging
from dataclasses import replace

import torch
from torch import Tensor

from lerobot_pf2mp.policies.guided.field_settings import FieldSettings
from lerobot_pf2mp.potential_field import PotentialField, fit

logger = logging.getLogger(__name__)


class DemonstratedActions:
    """A uniform sample of the frames on which a policy is trained, and the potential field fitted to their actions.

    Frames are ranked by a hash of their index in the dataset. The first `n_points` in that order are kept. So the sample
    is uniform over the distinct frames seen so far. It does not depend on how often or in which order they were seen, and
    it needs no random state.

    Args:
        settings: The settings of the sample and of the field.
    """

    def __init__(self, settings: FieldSettings) -> None:
        self.settings = settings
        self._start_afresh(dataset_id=b"")

    def _start_afresh(self, dataset_id: bytes) -> None:
        self._dataset_id = dataset_id
        self._n_shown = 0
        self._ranks = torch.empty(0, dtype=torch.int64)  # (P,) ascending
        self._points = torch.empty(0, 0)  # (P, D), in the order of the ranks
        self._fitted: tuple[FieldSettings, PotentialField] | None = None

    def __len__(self) -> int:
        return len(self._ranks)

    def observe(
        self,
        actions: Tensor,
        is_pad: Tensor | None,
        frames: Tensor | None,
        *,
        settings: FieldSettings,
        dataset_id: bytes = b"",
    ) -> None:
        """Adds the actions of a training batch to the sample.

        Args:
            actions: ``(B, T, A)`` chunks [normalised].
            is_pad: ``(B, T)`` true where a chunk reaches beyond its episode; those actions are left out.
            frames: ``(B,)`` index in the dataset of each chunk's first action. With None, every action counts as a new
                frame.
            settings: The settings of the sample. If their action dimensions differ from those of before, a new sample
                starts.
            dataset_id: Identifies the dataset and its normalisation. If it differs from that of before, a new sample
                starts.

        Raises:
            ValueError: If an action is not finite or a dimension does not exist.
        """
        if (dataset_id, settings.action_dims) != (self._dataset_id, self.settings.action_dims):
            if len(self):
                logger.info("The demonstrations have changed: the potential field is fitted to the new ones.")
            self._start_afresh(dataset_id)
        self.settings = settings
        actions = _select_dims(actions.detach().float(), settings.action_dims)
        steps = torch.arange(actions.shape[1], device=actions.device)
        if frames is None:
            frames = self._n_shown + actions.shape[1] * torch.arange(len(actions), device=actions.device)
            self._n_shown += actions.shape[0] * actions.shape[1]
        ranks = _hash(frames.to(actions.device).reshape(-1, 1) + steps)  # (B, T)
        keep = torch.ones_like(ranks, dtype=torch.bool) if is_pad is None else ~is_pad
        if len(self) >= settings.n_points:
            keep = keep & (ranks < self._ranks[settings.n_points - 1].to(ranks.device))
        self._merge(ranks[keep], actions[keep])

    def field(
        self, settings: FieldSettings | None = None, device: torch.device | str = "cpu"
    ) -> PotentialField:
        """The potential field of the frames seen so far.

        Args:
            settings: The settings of the field; None for those of training.
            device: Device of the field. The field stays there until another device is requested.

        Returns:
            The field. It is fitted at the first call, and again after its frames or settings have changed.

        Raises:
            ValueError: If there are no frames yet, or the settings have other action dimensions than the sample.
        """
        settings = settings or self.settings
        if not len(self):
            raise ValueError(
                "the potential field is not fitted: it has seen no demonstrations. Train the policy, load a checkpoint "
                "whose preprocessor holds the field, or set guidance_scale=0"
            )
        if settings.action_dims != self.settings.action_dims:
            raise ValueError(
                f"field_action_dims must be {self.settings.action_dims}, as in training, got {settings.action_dims}"
            )
        if self._fitted is None or self._fitted[0] != settings:
            if self._fitted is not None and replace(self._fitted[0], alpha=settings.alpha) == settings:
                fitted = self._fitted[1]
                field = PotentialField(
                    fitted.anchors, fitted.bandwidth, fitted.log_threshold, alpha=settings.alpha
                )
            else:
                field = fit(
                    self._points[: settings.n_points].cpu(),
                    bandwidth=settings.bandwidth,
                    threshold_quantile=settings.threshold_quantile,
                    alpha=settings.alpha,
                )
            self._fitted = (settings, field)
        self._fitted = (settings, self._fitted[1].to(device))
        return self._fitted[1]

    def state_dict(self) -> dict[str, Tensor]:
        """The sample and the fitted field as CPU tensors; empty if there are no frames yet."""
        if not len(self):
            return {}
        field = self.field()
        return {
            "points": self._points.cpu().contiguous(),
            "ranks": self._ranks.cpu().contiguous(),
            "n_shown": torch.tensor(self._n_shown),
            "dataset_id": torch.tensor(list(self._dataset_id), dtype=torch.uint8),
            "bandwidth": torch.tensor(field.bandwidth, dtype=torch.float64),
            "log_threshold": torch.tensor(field.log_threshold, dtype=torch.float64),
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restores the sample and the fitted field bit for bit.

        Args:
            state: The result of `state_dict`.

        Raises:
            ValueError: If an entry is missing or of the wrong kind, as in a corrupted file.
        """
        wanted = {"points", "ranks", "n_shown", "dataset_id", "bandwidth", "log_threshold"}
        if not wanted <= set(state):
            raise ValueError(
                f"a potential field file must hold {sorted(wanted)}, got {sorted(state)}: it is corrupted"
            )
        points, ranks = state["points"], state["ranks"]
        dims = self.settings.action_dims
        if points.ndim != 2 or ranks.shape != points.shape[:1] or not torch.isfinite(points).all():
            raise ValueError(
                "a potential field file must hold finite points (P, D) with P ranks, got points "
                f"{tuple(points.shape)} and ranks {tuple(ranks.shape)}: it is corrupted"
            )
        if dims is not None and points.shape[1] != len(dims):
            raise ValueError(
                f"the potential field file must cover the action dimensions {dims}, got points of {points.shape[1]}"
            )
        for name in ("n_shown", "bandwidth", "log_threshold"):
            if state[name].numel() != 1:
                raise ValueError(
                    f"{name} in a potential field file must be one number, got {tuple(state[name].shape)}: "
                    "it is corrupted"
                )
        self._points, self._ranks = points.float(), ranks
        self._n_shown = int(state["n_shown"])
        self._dataset_id = bytes(state["dataset_id"].tolist())
        field = PotentialField(
            self._points[: self.settings.n_points],
            bandwidth=state["bandwidth"].item(),
            log_threshold=state["log_threshold"].item(),
            alpha=self.settings.alpha,
        )
        self._fitted = (self.settings, field)

    def _merge(self, ranks: Tensor, points: Tensor) -> None:
        if not len(ranks):
            return
        if not torch.isfinite(points).all():
            raise ValueError(
                "demonstrated actions must be finite, got NaN or infinite values in the training batch"
            )
        if len(self):
            known = self._ranks.to(ranks.device)
            closest = known[torch.searchsorted(known, ranks).clamp_max(len(known) - 1)]
            if torch.equal(closest, ranks) and len(self) <= self.settings.n_points:
                return  # no new frames: the fitted field stays valid
            ranks = torch.cat([ranks, known])
            points = torch.cat([points, self._points.to(points.device)])
        ranks, order = ranks.sort(stable=True)
        is_first = torch.ones_like(ranks, dtype=torch.bool)
        is_first[1:] = ranks[1:] != ranks[:-1]  # the hash is one to one: an equal rank is the same frame
        self._ranks = ranks[is_first][: self.settings.n_points]
        self._points = points[order][is_first][: self.settings.n_points]
        self._fitted = None


def _select_dims(actions: Tensor, dims: tuple[int, ...] | None) -> Tensor:
    if dims is None:
        return actions
    if max(dims) >= actions.shape[-1]:
        raise ValueError(
            f"field_action_dims must be below the action dimension {actions.shape[-1]}, got {dims}"
        )
    return actions[..., list(dims)]


def _hash(x: Tensor) -> Tensor:
    """A one-to-one scrambling of int64 numbers: the finaliser of splitmix64 (Steele et al., 2014)."""
    x = x + -0x61C8864680B583EB
    x = (x ^ ((x >> 30) & 0x3FFFFFFFF)) * -0x40A7B892E31B1A47
    x = (x ^ ((x >> 27) & 0x1FFFFFFFFF)) * -0x6B2FB644ECCEEE15
    return x ^ ((x >> 31) & 0x1FFFFFFFF)
