# SPDX-License-Identifier: Apache-2.0
"""The demonstrated actions on which a policy is trained, and the potential field fitted to them."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import cast

import torch
from torch import Tensor

from lerobot_pf2mp.policies.guided.field_settings import FieldSettings, density_of
from lerobot_pf2mp.policies.guided.field_state import ANCHOR, OUTLYING, SAFE_ANCHOR, FieldState
from lerobot_pf2mp.policies.guided.frame_ranks import frame_of, rank_of
from lerobot_pf2mp.policies.guided.recorded_angles import JUMP, steps_seen
from lerobot_pf2mp.policies.guided.remarks import remarks_on_dimensions, remarks_on_outlying
from lerobot_pf2mp.policies.plans.calibration import PlanCalibration
from lerobot_pf2mp.policies.plans.demonstrated_plans import DemonstratedPlans
from lerobot_pf2mp.policies.plans.plan_threshold import PlanThreshold
from lerobot_pf2mp.potential_field import (
    JudgedFit,
    PotentialField,
    fit,
    fit_judged,
    just_below_quantile,
)

logger = logging.getLogger(__name__)

# Largest difference of an action that is read again, relative to 1 and to the action, that is rounding.
_SAME_ACTION = 1e-4


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
        self._forget_units()
        self._start_afresh(dataset_id=b"")

    def _forget_units(self) -> None:
        self._unit = torch.empty(0)  # (D,) one recorded unit [normalised]; empty if unknown
        self._steps = torch.empty(0, dtype=torch.uint8)  # (D,) `steps_seen` so far; empty if unknown

    def _start_afresh(self, dataset_id: bytes, why: str = "") -> None:
        if why:
            logger.warning(
                "The potential field starts afresh, from the frames of this run: %s. The %d actions kept before are "
                "dropped.",
                why,
                len(self),
            )
        self._dataset_id = dataset_id
        self._n_shown = 0
        self._ranks = torch.empty(0, dtype=torch.int64)  # (P,) ascending
        self._points = torch.empty(0, 0)  # (P, D), in the order of the ranks
        self._episodes = torch.empty(0, dtype=torch.int64)  # (P,) -1 if unknown
        self.calibration = PlanCalibration()
        self._forget_field()

    def _forget_field(self) -> None:
        self._fitted: tuple[FieldSettings, PotentialField] | None = None
        self._is_outlying = torch.empty(0, dtype=torch.bool)  # (P,) of the fitted field's points
        self._held_out = torch.empty(0)  # (N,) log densities of its points without their own episodes [nats]
        self.calibration.forget_scores()

    def __len__(self) -> int:
        return len(self._ranks)

    @property
    def points(self) -> Tensor:
        """``(P, D)`` actions of the sample's frames [normalised]."""
        return self._points.cpu()

    @property
    def episodes(self) -> Tensor | None:
        """``(P,)`` int64 episode numbers of the sample's frames; None if they are unknown."""
        return self._episodes.cpu() if len(self) and bool((self._episodes >= 0).all()) else None

    @property
    def frames(self) -> Tensor:
        """``(P,)`` int64 indices in the dataset of the sample's frames."""
        return frame_of(self._ranks.cpu())

    def observe(
        self,
        actions: Tensor,
        is_pad: Tensor | None,
        frames: Tensor | None,
        episodes: Tensor | None = None,
        *,
        settings: FieldSettings,
        unit: Tensor | None = None,
        dataset_id: bytes = b"",
        n_past: int = 0,
        n_executed: int | None = None,
        drop_n_last_frames: int = 0,
        states: Tensor | None = None,
        places: Tensor | None = None,
    ) -> None:
        """Adds the actions of a training batch to the sample.

        Args:
            actions: ``(B, T, A)`` chunks [normalised].
            is_pad: ``(B, T)`` true where a chunk reaches beyond its episode; those actions are left out.
            frames: ``(B,)`` index in the dataset of each chunk's first action. With None, every action counts as a new
                frame.
            episodes: ``(B,)`` number of each chunk's episode; None if it is unknown.
            settings: The settings of the sample. If their action dimensions differ from those of before, or they ask for
                more points than the sample has kept, a new sample starts.
            unit: ``(A,)`` what one unit of the recorded actions is in normalised actions, for the periods of angles; None
                if it is unknown.
            dataset_id: Identifies the run's frames and their normalisation. If it differs from that of before, a new
                sample starts.
            n_past: Number of a chunk's first actions that lie before the current step.
            n_executed: Number of actions from the current step on that the policy executes; None if the chunks are no plans.
            drop_n_last_frames: Number of an episode's last frames with which no plan begins.
            states: ``(B, A)`` observed states at the current step [normalised]; None if there are none.
            places: ``(2, A)`` how states become actions, see `places_of_states`; None if it is unknown.

        Raises:
            ValueError: If an action is not finite or a dimension does not exist.
        """
        why = self._why_afresh(settings, dataset_id)
        if why is not None:
            self._forget_units()
            self._start_afresh(dataset_id, why if len(self) else "")
        self.settings = settings
        actions = actions.detach().float()
        if unit is not None:
            self.recognise_angles(actions, is_pad, unit)
        if n_executed is not None and frames is not None and episodes is not None:
            is_plan: Tensor | slice = slice(None)
            if is_pad is not None:
                n_left = (~is_pad[:, n_past:]).sum(dim=1)  # in the episode
                n_dropped = min(drop_n_last_frames, actions.shape[1] - n_past - 1)
                is_plan = n_left > max(
                    n_dropped, n_executed - 1
                )  # copies at its end would support a plan better
            self.observe_plans(
                actions[is_plan, n_past:],
                (frames + n_past)[is_plan],
                episodes[is_plan],
                states=None if states is None else states[is_plan],
                places=places,
                n_executed=n_executed,
            )
        actions = _select_dims(actions, settings.action_dims)
        steps = torch.arange(actions.shape[1], device=actions.device)
        if frames is None:
            frames = self._n_shown + actions.shape[1] * torch.arange(len(actions), device=actions.device)
            self._n_shown += actions.shape[0] * actions.shape[1]
        ranks = rank_of(frames.to(actions.device).reshape(-1, 1) + steps)  # (B, T)
        if episodes is None:
            episodes = torch.full((len(actions),), -1)
        episodes = episodes.to(actions.device).reshape(-1, 1).expand_as(ranks)
        keep = torch.ones_like(ranks, dtype=torch.bool) if is_pad is None else ~is_pad
        if len(self) >= settings.n_points:
            keep = keep & (ranks <= self._ranks[settings.n_points - 1].to(ranks.device))
        self._merge(ranks[keep], actions[keep], episodes[keep])

    def observe_plans(
        self,
        actions: Tensor,
        frames: Tensor,
        episodes: Tensor,
        *,
        states: Tensor | None,
        places: Tensor | None,
        n_executed: int,
    ) -> None:
        """Adds demonstrated plans, with which plans are calibrated.

        Args:
            actions: ``(B, T, A)`` actions from the current step on [normalised].
            frames: ``(B,)`` index in the dataset of the current step.
            episodes: ``(B,)`` episode numbers.
            states: As for `observe`.
            places: As there.
            n_executed: As there.
        """
        dims = self.settings.action_dims
        is_known = states is not None and places is not None and bool(places.numel())
        self.calibration.observe(
            _select_dims(actions.detach().float(), dims),
            frames,
            episodes,
            states=_select_dims(cast(Tensor, states), dims) if is_known else None,
            places=_select_dims(cast(Tensor, places), dims) if is_known else None,
            n_executed=n_executed,
        )

    def place_of(self, states: Tensor) -> Tensor:
        """Where a robot is, as an action over the field's dimensions, ``(B, D)`` [normalised].

        Args:
            states: ``(B, A)`` observed states [normalised], of which `places` are known.
        """
        return self.calibration.place_of(_select_dims(states, self.settings.action_dims))

    def recognise_angles(self, actions: Tensor, is_pad: Tensor | None, unit: Tensor) -> None:
        """Looks for jumps by a period in successive actions, which make their dimension an angle.

        Args:
            actions: ``(B, T, A)`` successive actions [normalised].
            is_pad: ``(B, T)`` true where an action does not follow the one before it.
            unit: ``(A,)`` what one unit of the recorded actions is in normalised actions.
        """
        self._unit = _select_dims(unit.float(), self.settings.action_dims).cpu()
        actions = _select_dims(actions, self.settings.action_dims)
        steps = steps_seen(actions, is_pad, self._unit * self.settings.angle_period)
        if len(self._steps):
            steps |= self._steps
        if not torch.equal(steps == JUMP, self._steps == JUMP):
            self._forget_field()
        self._steps = steps

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
            ValueError: If there are no frames yet, or the settings have other action dimensions than the sample, ask for
                more points than it has kept, or name angles whose unit is unknown.
        """
        settings = settings or self.settings
        self._check(settings)
        if self._fitted is None or self._fitted[0] != settings:
            if self._fitted is not None and density_of(self._fitted[0]) == density_of(settings):
                field = self._fitted[1]
            else:
                field = self._fit(settings)
            self._fitted = (settings, self._on_density(field, settings))
        self._fitted = (settings, self._fitted[1].to(device))
        return self._fitted[1]

    def plan_threshold(
        self, settings: FieldSettings, n_actions: int, false_alarm_rate: float
    ) -> PlanThreshold:
        """The threshold for the support of plans, calibrated on demonstrated plans.

        Args:
            settings: The settings of the field.
            n_actions: Number of actions of a plan that are executed.
            false_alarm_rate: Largest probability with which a plan as good as a fresh demonstration is flagged.

        Raises:
            ValueError: If there are no demonstrated plans, none that other episodes can judge, or they have fewer actions.
        """
        self._check(settings)
        return self.calibration.threshold(
            density_of(settings),
            n_actions,
            false_alarm_rate,
            lambda: self._score_plans(settings, n_actions),
            can_judge=self.episodes is not None,
        )

    def _score_plans(self, settings: FieldSettings, n_actions: int) -> Tensor:
        # On the device on which it is used, so that it need not be prepared again.
        field = self.field(settings, "cpu" if self._fitted is None else self._fitted[1].anchors.device)
        is_anchor = ~self._is_outlying
        episodes = self.episodes if settings.leave_out == "episode" else None
        return self.calibration.plans.scores(
            field,
            None if episodes is None else episodes[: settings.n_points][is_anchor],
            self.frames[: settings.n_points][is_anchor],
            n_actions,
            starts_at_state=self.calibration.starts_at_state,
        )

    def _on_density(self, field: PotentialField, settings: FieldSettings) -> PotentialField:
        """The field with the distance term, and pulling where the settings say."""
        full = none = math.inf
        # The file of a field from before 0.2 does not tell where support is missing. It pulls everywhere, as it did.
        if settings.region != "everywhere" and len(self._held_out):
            none = just_below_quantile(self._held_out, settings.quantile)
            full = none if settings.region == "unsupported" else min(field.log_threshold, none)
        return replace(field, alpha=settings.alpha, log_full_pull=full, log_no_pull=none)

    def judged(self, settings: FieldSettings | None = None) -> JudgedFit:
        """The field, fitted anew, and how each of its points is judged by other episodes. Arguments and errors as above."""
        settings = settings or self.settings
        self._check(settings)
        n_points = settings.n_points
        return fit_judged(
            self._points[:n_points].cpu(),
            episodes=None if self.episodes is None else self.episodes[:n_points],
            times=self.frames[:n_points],
            periods=self._periods(settings),
            bandwidth=settings.bandwidth,
            threshold_quantile=settings.threshold_quantile,
            alpha=settings.alpha,
        )

    def state_dict(self) -> dict[str, Tensor]:
        """The sample and the fitted field as CPU tensors; empty if there are no frames yet."""
        if not len(self):
            return {}
        field = self.field()
        calibration, n_executed = self.calibration, self.calibration.n_executed
        scores = torch.empty(0)
        if n_executed <= calibration.plans.n_actions and self.episodes is not None:
            scores = calibration.scores(
                density_of(self.settings), n_executed, lambda: self._score_plans(self.settings, n_executed)
            )
        is_outlying = self._is_outlying
        role = torch.where(is_outlying, OUTLYING, ANCHOR).to(torch.uint8)
        role[~is_outlying] += field.safe_anchors.cpu().to(torch.uint8)
        return FieldState(
            points=self._points.cpu().contiguous(),
            ranks=self._ranks.cpu().contiguous(),
            n_shown=torch.tensor(self._n_shown),
            dataset_id=torch.tensor(list(self._dataset_id), dtype=torch.uint8),
            bandwidth=torch.tensor(field.bandwidth, dtype=torch.float64),
            log_threshold=torch.tensor(field.log_threshold, dtype=torch.float64),
            episodes=self._episodes.cpu().contiguous(),
            unit=self._unit.clone(),
            steps=self._steps.clone(),
            role=role,
            places=calibration.places.clone(),
            held_out=self._held_out.cpu().contiguous(),
            plans=calibration.plans.ways.cpu().contiguous(),
            plan_episodes=calibration.plans.episodes.cpu().contiguous(),
            plan_ranks=calibration.plans.ranks.cpu().contiguous(),
            plan_scores=scores,
            n_executed=torch.tensor(n_executed),
        ).tensors()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restores the sample and the fitted field bit for bit.

        Args:
            state: The result of `state_dict`.

        Raises:
            ValueError: If an entry is missing or of the wrong kind, as in a corrupted file.
        """
        read = FieldState.read(state)
        dims, dim = self.settings.action_dims, read.points.shape[1]
        if dims is not None and dim != len(dims):
            raise ValueError(
                f"the potential field file must cover the action dimensions {dims}, got points of {dim}"
            )
        self._points, self._ranks, self._episodes = read.points.float(), read.ranks, read.episodes
        self._unit, self._steps = read.unit.float(), read.steps
        self._n_shown = int(read.n_shown)
        self._dataset_id = bytes(read.dataset_id.tolist())
        plans = DemonstratedPlans()
        plans.restore(read.plans, read.plan_episodes, read.plan_ranks)
        self.calibration.restore(
            plans, read.places, int(read.n_executed), density_of(self.settings), read.plan_scores
        )
        role = read.role[: self.settings.n_points]
        self._is_outlying, self._held_out = role == OUTLYING, read.held_out
        field = PotentialField(
            self._points[: self.settings.n_points][~self._is_outlying],
            bandwidth=read.bandwidth.item(),
            log_threshold=read.log_threshold.item(),
            alpha=self.settings.alpha,
            periods=self._periods(self.settings),
            # A file of before has no roles. Its safe anchors are those whose own density is above the threshold.
            anchor_is_safe=role[~self._is_outlying] == SAFE_ANCHOR if "role" in state else None,
        )
        self._fitted = (self.settings, self._on_density(field, self.settings))

    def _check(self, settings: FieldSettings) -> None:
        if not len(self):
            raise ValueError(
                "the potential field is not fitted: it has seen no demonstrations. Train the policy, load a checkpoint "
                "whose preprocessor holds the field, or set guidance_scale=0, max_plans=1 and on_unsupported=ignore"
            )
        if settings.action_dims != self.settings.action_dims:
            raise ValueError(
                f"field_action_dims must be {self.settings.action_dims}, as in training, got {settings.action_dims}"
            )
        if settings.n_points > max(len(self), self.settings.n_points):
            raise ValueError(
                f"n_field_points must be at most {len(self)}, the number of actions kept with the checkpoint, got "
                f"{settings.n_points}; pf2mp-fit-field keeps more"
            )

    def _fit(self, settings: FieldSettings) -> PotentialField:
        """Fits the field, and says what is remarkable about the points."""
        points = self._points[: settings.n_points].cpu()
        dims = settings.action_dims or tuple(range(points.shape[1]))
        if settings.leave_out == "nothing":
            self._is_outlying = torch.zeros(len(points), dtype=torch.bool)
            field = fit(
                points,
                periods=self._periods(settings),
                bandwidth=settings.bandwidth,
                threshold_quantile=settings.threshold_quantile,
                alpha=settings.alpha,
                leave_out="nothing",
            )
            self._held_out = field.log_density(points)
        else:
            judged = self.judged(settings)
            field, self._is_outlying = judged.field, judged.is_outlying
            log_density = judged.log_density[~judged.is_far]
            self._held_out = log_density[log_density.isfinite()].float()
            remark = remarks_on_outlying(judged, self.episodes, self.frames)
            if remark:
                logger.warning(remark)
        remark = remarks_on_dimensions(points[~self._is_outlying], field.bandwidth, dims)
        if remark:
            logger.warning(remark)
        return field

    def _periods(self, settings: FieldSettings) -> Tensor | None:
        """``(D,)`` the periods of the field's dimensions [normalised], 0 for those that are no angles."""
        dims = settings.action_dims or tuple(range(self._points.shape[1]))
        if settings.angle_dims is None:
            is_angle = self._steps == JUMP
        else:
            if settings.angle_dims and not len(self._unit):
                raise ValueError(
                    f"field_angle_dims must be empty or null, got {settings.angle_dims}: the field does not know how "
                    "the recorded actions were normalised. pf2mp-fit-field makes a field that does"
                )
            is_angle = torch.tensor([dim in settings.angle_dims for dim in dims])
        if not bool(is_angle.any()):
            return None
        return torch.where(is_angle, self._unit * settings.angle_period, 0.0)

    def _why_afresh(self, settings: FieldSettings, dataset_id: bytes) -> str | None:
        if dataset_id != self._dataset_id:
            return "its dataset, episodes or normalisation differ from those of before"
        if settings.action_dims != self.settings.action_dims:
            return f"field_action_dims are {settings.action_dims}, before {self.settings.action_dims}"
        if settings.n_points > self.settings.n_points and len(self) >= self.settings.n_points:
            return f"n_field_points is {settings.n_points}, before {self.settings.n_points}"
        return None

    def _merge(self, ranks: Tensor, points: Tensor, episodes: Tensor) -> None:
        if not len(ranks):
            return
        if not torch.isfinite(points).all():
            raise ValueError(
                "demonstrated actions must be finite, got NaN or infinite values in the training batch"
            )
        if len(self):
            known, known_points = self._ranks.to(ranks.device), self._points.to(points.device)
            place = torch.searchsorted(known, ranks).clamp_max(len(known) - 1)
            is_known = known[place] == ranks
            difference = (known_points[place] - points).abs()
            if bool((is_known & (difference > _SAME_ACTION * (1 + points.abs())).any(dim=-1)).any()):
                self._start_afresh(self._dataset_id, "its frames have other actions than before")
            elif bool(is_known.all()) and len(self) <= self.settings.n_points:
                return  # no new frames: the fitted field stays valid
            else:
                ranks, points = torch.cat([ranks, known]), torch.cat([points, known_points])
                episodes = torch.cat([episodes, self._episodes.to(episodes.device)])
        ranks, order = ranks.sort(stable=True)
        is_first = torch.ones_like(ranks, dtype=torch.bool)
        is_first[1:] = ranks[1:] != ranks[:-1]  # the hash is one to one: an equal rank is the same frame
        n_points = self.settings.n_points
        self._ranks = ranks[is_first][:n_points]
        self._points = points[order][is_first][:n_points]
        self._episodes = episodes[order][is_first][:n_points]
        self._forget_field()


def _select_dims(actions: Tensor, dims: tuple[int, ...] | None) -> Tensor:
    if dims is None:
        return actions
    if max(dims) >= actions.shape[-1]:
        raise ValueError(
            f"field_action_dims must be below the action dimension {actions.shape[-1]}, got {dims}"
        )
    return actions[..., list(dims)]
