# SPDX-License-Identifier: Apache-2.0
"""The potential field of a sample of demonstrated actions, as it was fitted."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lerobot_pf2mp.policies.guided.action_sample import ActionSample
from lerobot_pf2mp.policies.guided.field_settings import FieldSettings
from lerobot_pf2mp.policies.guided.remarks import remarks_on_dimensions, remarks_on_outlying
from lerobot_pf2mp.potential_field import JudgedFit, PotentialField, fit, fit_judged, just_below_quantile

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class FittedSample:
    """A field, and how the sample was judged while it was fitted.

    Args:
        field: The field.
        is_outlying: ``(P,)`` bool, the points that are no anchors.
        held_out: ``(N,)`` log densities of points without their own episodes [nats]; empty in files of before 0.2.
    """

    field: PotentialField
    is_outlying: Tensor
    held_out: Tensor

    def region(self, settings: FieldSettings) -> str:
        """Where the field pulls, one of `REGIONS`.

        A field from before 0.2 does not tell where support is missing. It pulls everywhere, as it did.
        """
        return settings.region if len(self.held_out) else "everywhere"

    def pulling(self, settings: FieldSettings) -> FittedSample:
        """The same density with the distance term, and a pull where the settings say."""
        full = none = math.inf
        region = self.region(settings)
        if region != "everywhere":
            none = just_below_quantile(self.held_out, settings.quantile)
            full = none if region == "unsupported" else min(self.field.log_threshold, none)
        return replace(
            self, field=replace(self.field, alpha=settings.alpha, log_full_pull=full, log_no_pull=none)
        )

    def to(self, device: torch.device | str) -> FittedSample:
        """The same with the field on a device."""
        return replace(self, field=self.field.to(device))


def judge_sample(sample: ActionSample, settings: FieldSettings, periods: Tensor | None) -> JudgedFit:
    """Fits a field, and judges each point of the sample by other episodes.

    Args:
        sample: The demonstrated actions.
        settings: The settings of the field.
        periods: ``(D,)`` periods of angles [normalised], 0 for other dimensions; None if there are no angles.
    """
    episodes = sample.known_episodes
    return fit_judged(
        sample.points.cpu()[: settings.n_points],
        episodes=None if episodes is None else episodes[: settings.n_points],
        times=sample.frames[: settings.n_points],
        periods=periods,
        bandwidth=settings.bandwidth,
        threshold_quantile=settings.threshold_quantile,
        alpha=settings.alpha,
    )


def fit_sample(sample: ActionSample, settings: FieldSettings, periods: Tensor | None) -> FittedSample:
    """Fits a field, and says what is remarkable about the points. Arguments as for `judge_sample`."""
    points = sample.points.cpu()[: settings.n_points]
    if settings.leave_out == "nothing":
        field = fit(
            points,
            periods=periods,
            bandwidth=settings.bandwidth,
            threshold_quantile=settings.threshold_quantile,
            alpha=settings.alpha,
            leave_out="nothing",
        )
        is_outlying, held_out = torch.zeros(len(points), dtype=torch.bool), field.log_density(points)
    else:
        judged = judge_sample(sample, settings, periods)
        field, is_outlying = judged.field, judged.is_outlying
        held_out = judged.log_density[~judged.is_far]
        held_out = held_out[held_out.isfinite()].float()
        remark = remarks_on_outlying(judged, sample.known_episodes, sample.frames)
        if remark:
            logger.warning(remark)
    dims = settings.action_dims or tuple(range(points.shape[1]))
    remark = remarks_on_dimensions(points[~is_outlying], field.bandwidth, dims)
    if remark:
        logger.warning(remark)
    return FittedSample(field, is_outlying, held_out)
