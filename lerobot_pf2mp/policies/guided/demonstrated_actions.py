# SPDX-License-Identifier: Apache-2.0
"""The demonstrated actions on which a policy is trained, and the potential field fitted to them."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import cast

import torch
from torch import Tensor

from lerobot_pf2mp.policies.guided.action_sample import ActionSample
from lerobot_pf2mp.policies.guided.field_settings import ACTIONS, INTEGRATED, FieldSettings, density_of
from lerobot_pf2mp.policies.guided.field_state import ANCHOR, OUTLYING, SAFE_ANCHOR, FieldState
from lerobot_pf2mp.policies.guided.fitted_sample import FittedSample, fit_sample, judge_sample
from lerobot_pf2mp.policies.guided.integrated_actions import Integration
from lerobot_pf2mp.policies.guided.recorded_angles import RecordedAngles
from lerobot_pf2mp.policies.obstacles.recorded_units import RecordedUnits
from lerobot_pf2mp.policies.plans.calibration import PlanCalibration
from lerobot_pf2mp.policies.plans.demonstrated_plans import DemonstratedPlans
from lerobot_pf2mp.policies.plans.plan_threshold import PlanThreshold
from lerobot_pf2mp.potential_field import JudgedFit, PotentialField

logger = logging.getLogger(__name__)


class DemonstratedActions:
    """An `ActionSample` of the frames on which a policy is trained, and the potential field fitted to their actions.

    Of actions that are displacements it gets, and holds, the positions to which they lead (see `integrated_actions`).

    Args:
        settings: The settings of the sample and of the field.
    """

    def __init__(self, settings: FieldSettings) -> None:
        self.settings = settings
        # Of the preprocessor that holds them; None until it has been called.
        self.recorded_units: RecordedUnits | None = None
        self._angles = RecordedAngles()
        self._start_afresh(dataset_id=b"")

    def _start_afresh(self, dataset_id: bytes, why: str = "") -> None:
        if why:
            logger.warning(
                "The potential field starts afresh, from the frames of this run: %s. The %d actions kept before are "
                "dropped.",
                why,
                len(self),
            )
        self._dataset_id = dataset_id
        self._sample = ActionSample()
        self._integration: Integration | None = None
        self.calibration = PlanCalibration()
        self._forget_field()

    def _forget_field(self) -> None:
        self._fitted: tuple[FieldSettings, FittedSample] | None = None
        self.calibration.forget_scores()

    def __len__(self) -> int:
        return len(self._sample)

    @property
    def points(self) -> Tensor:
        """``(P, D)`` actions of the sample's frames [normalised]."""
        return self._sample.points.cpu()

    @property
    def episodes(self) -> Tensor | None:
        """``(P,)`` int64 episode numbers of the sample's frames; None if they are unknown."""
        return self._sample.known_episodes

    @property
    def frames(self) -> Tensor:
        """``(P,)`` int64 indices in the dataset of the sample's frames."""
        return self._sample.frames

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
        integration: Integration | None = None,
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
            integration: How displacements became the positions that are given as actions; None for actions as recorded.

        Raises:
            ValueError: If an action is not finite or a dimension does not exist.
        """
        why = self._why_afresh(settings, dataset_id)
        if why is not None:
            self._angles = RecordedAngles()
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
        if settings.over == INTEGRATED:
            self._integration = integration
            actions, is_pad, frames, episodes = ActionSample.each_by_itself(actions, is_pad, frames, episodes)
        n_points = settings.n_points
        new = self._sample.candidates(actions, is_pad, frames, episodes, n_points)
        if self._sample.contradicts(new):
            self._start_afresh(self._dataset_id, "its frames have other actions than before")
        if self._sample.merge(new, n_points):
            self._forget_field()

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

    def starts_at_state(self, settings: FieldSettings) -> bool:
        """Whether an observed state tells where the robot is, in the units of its actions.

        Sums of displacements begin there.
        """
        return settings.over == INTEGRATED or self.calibration.starts_at_state(self._periods(settings))

    def integration(self, settings: FieldSettings) -> Integration:
        """How displacements become positions of the field.

        Raises:
            ValueError: If the field is not fitted, or over other positions than the settings'.
        """
        self._check(settings)
        assert self._integration is not None  # `_check` refuses it
        return self._integration

    def recognise_angles(self, actions: Tensor, is_pad: Tensor | None, unit: Tensor) -> None:
        """Looks for jumps by a period in successive actions, which make their dimension an angle.

        Args:
            actions: ``(B, T, A)`` successive actions [normalised].
            is_pad: ``(B, T)`` true where an action does not follow the one before it.
            unit: ``(A,)`` what one unit of the recorded actions is in normalised actions.
        """
        dims = self.settings.action_dims
        if self._angles.see(
            _select_dims(actions, dims),
            is_pad,
            _select_dims(unit.float(), dims),
            self.settings.angle_period,
        ):
            self._forget_field()

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
        return self._fit(settings or self.settings, device).field

    def _fit(self, settings: FieldSettings, device: torch.device | str | None = None) -> FittedSample:
        """The fitted sample, on a device; None for the device on which it is used."""
        self._check(settings)
        if self._fitted is None or self._fitted[0] != settings:
            if self._fitted is not None and density_of(self._fitted[0]) == density_of(settings):
                fitted = self._fitted[1]
            else:
                fitted = fit_sample(self._sample, settings, self._periods(settings))
            self._fitted = (settings, fitted.pulling(settings))
        if device is not None:
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
        fitted = self._fit(settings)
        is_anchor = ~fitted.is_outlying
        episodes = self.episodes if settings.leave_out == "episode" else None
        return self.calibration.plans.scores(
            fitted.field,
            None if episodes is None else episodes[: settings.n_points][is_anchor],
            self.frames[: settings.n_points][is_anchor],
            n_actions,
            starts_at_state=self.starts_at_state(settings),
        )

    def region(self, settings: FieldSettings) -> str:
        """Where the field pulls, see `FittedSample.region`."""
        return self._fit(settings).region(settings)

    def judged(self, settings: FieldSettings | None = None) -> JudgedFit:
        """The field, fitted anew, and how each of its points is judged by other episodes. Arguments and errors as above."""
        settings = settings or self.settings
        self._check(settings)
        return judge_sample(self._sample, settings, self._periods(settings))

    def state_dict(self) -> dict[str, Tensor]:
        """The sample and the fitted field as CPU tensors; empty if there are no frames yet."""
        if not len(self):
            return {}
        fitted = self._fit(self.settings)
        field, is_outlying = fitted.field, fitted.is_outlying
        calibration, n_executed = self.calibration, self.calibration.n_executed
        scores = torch.empty(0)
        if n_executed <= calibration.plans.n_actions and self.episodes is not None:
            scores = calibration.scores(
                density_of(self.settings), n_executed, lambda: self._score_plans(self.settings, n_executed)
            )
        role = torch.where(is_outlying, OUTLYING, ANCHOR).to(torch.uint8)
        role[~is_outlying] += field.safe_anchors.cpu().to(torch.uint8)
        return FieldState(
            points=self._sample.points.cpu().contiguous(),
            ranks=self._sample.ranks.cpu().contiguous(),
            n_shown=torch.tensor(self._sample.n_shown),
            dataset_id=torch.tensor(list(self._dataset_id), dtype=torch.uint8),
            bandwidth=torch.tensor(field.bandwidth, dtype=torch.float64),
            log_threshold=torch.tensor(field.log_threshold, dtype=torch.float64),
            episodes=self._sample.episodes.cpu().contiguous(),
            unit=self._angles.unit.clone(),
            steps=self._angles.steps.clone(),
            role=role,
            places=calibration.places.clone(),
            held_out=fitted.held_out.cpu().contiguous(),
            plans=calibration.plans.ways.cpu().contiguous(),
            plan_episodes=calibration.plans.episodes.cpu().contiguous(),
            plan_ranks=calibration.plans.ranks.cpu().contiguous(),
            plan_scores=scores,
            n_executed=torch.tensor(n_executed),
            integration=torch.empty(0, 0) if self._integration is None else self._integration.tensor(),
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
        self._sample = ActionSample(read.ranks, read.points.float(), read.episodes, int(read.n_shown))
        self._angles = RecordedAngles(read.unit.float(), read.steps)
        self._integration = Integration.of_tensor(read.integration) if read.integration.numel() else None
        self._dataset_id = bytes(read.dataset_id.tolist())
        plans = DemonstratedPlans()
        plans.restore(read.plans, read.plan_episodes, read.plan_ranks)
        self.calibration.restore(
            plans, read.places, int(read.n_executed), density_of(self.settings), read.plan_scores
        )
        role = read.role[: self.settings.n_points]
        is_outlying = role == OUTLYING
        field = PotentialField(
            self.points[: self.settings.n_points][~is_outlying],
            bandwidth=read.bandwidth.item(),
            log_threshold=read.log_threshold.item(),
            alpha=self.settings.alpha,
            periods=self._periods(self.settings),
            # A file of before has no roles. Its safe anchors are those whose own density is above the threshold.
            anchor_is_safe=role[~is_outlying] == SAFE_ANCHOR if "role" in state else None,
        )
        fitted = FittedSample(field, is_outlying, read.held_out)
        self._fitted = (self.settings, fitted.pulling(self.settings))

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
        kept = self.settings if self._integration is not None else replace(self.settings, over=ACTIONS)
        if settings.positions != kept.positions:
            raise ValueError(
                f"field_over must be {_described(kept)}, as in training, got {_described(settings)}; pf2mp-fit-field makes "
                "another field"
            )
        if settings.n_points > max(len(self), self.settings.n_points):
            raise ValueError(
                f"n_field_points must be at most {len(self)}, the number of actions kept with the checkpoint, got "
                f"{settings.n_points}; pf2mp-fit-field keeps more"
            )

    def _periods(self, settings: FieldSettings) -> Tensor | None:
        """``(D,)`` the periods of the field's dimensions [normalised], see `RecordedAngles.periods`."""
        dims = settings.action_dims or tuple(range(self._sample.points.shape[1]))
        return self._angles.periods(dims, settings)

    def _why_afresh(self, settings: FieldSettings, dataset_id: bytes) -> str | None:
        if dataset_id != self._dataset_id:
            return "its dataset, episodes or normalisation differ from those of before"
        if settings.action_dims != self.settings.action_dims:
            return f"field_action_dims are {settings.action_dims}, before {self.settings.action_dims}"
        if settings.positions != self.settings.positions:
            return f"field_over is {_described(settings)}, before {_described(self.settings)}"
        if settings.n_points > self.settings.n_points and len(self) >= self.settings.n_points:
            return f"n_field_points is {settings.n_points}, before {self.settings.n_points}"
        return None


def _described(settings: FieldSettings) -> str:
    over, scale, state_dims = settings.positions
    if over != INTEGRATED:
        return over
    of_state = "" if state_dims is None else f" and field_state_dims {state_dims}"
    return f"{over} with field_displacement_scale {scale:g}{of_state}"


def _select_dims(actions: Tensor, dims: tuple[int, ...] | None) -> Tensor:
    if dims is None:
        return actions
    if max(dims) >= actions.shape[-1]:
        raise ValueError(
            f"field_action_dims must be below the action dimension {actions.shape[-1]}, got {dims}"
        )
    return actions[..., list(dims)]
