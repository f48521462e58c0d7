# SPDX-License-Identifier: Apache-2.0
"""The part of a guided policy that uses the potential field.

It makes the guide from the field, and chooses plans with it; what training adds to the field is in `field_observer`.
"""

from __future__ import annotations

import logging
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import torch
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide
from lerobot_pf2mp.guidance import GuidanceSettings, make_guide
from lerobot_pf2mp.policies.batch_keys import POTENTIAL_FIELD
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.field_observer import FieldObserver
from lerobot_pf2mp.policies.guided.field_settings import INTEGRATED
from lerobot_pf2mp.policies.guided.fitted_field import fitted_field
from lerobot_pf2mp.policies.guided.integrated_actions import (
    IntegratedActions,
    IntegratedGuide,
)
from lerobot_pf2mp.policies.obstacles.known_obstacles import OBS_OBSTACLES, known_obstacles
from lerobot_pf2mp.policies.obstacles.obstacle_guidance import ObstacleCheck, ObstacleGuidance
from lerobot_pf2mp.policies.plans.plan_choice import DrawMore, PlanCheck, WayCheck, choose_plans, react
from lerobot_pf2mp.policies.plans.plans import Plans, require_finite
from lerobot_pf2mp.policies.plans.robot_places import RobotPlaces, seen_place
from lerobot_pf2mp.potential_field import PotentialField

if TYPE_CHECKING:
    from lerobot_pf2mp.policies.guided.fitted_field import GuidedPolicyConfig


logger = logging.getLogger(__name__)


class FieldGuidance:
    """Guidance by a potential field, held by one policy.

    The field itself is in the batch. The policy's preprocessor puts it there (see `potential_field_step`).

    Args:
        config: The policy's configuration. Its options may change between two calls.
        dataset_stats: Statistics of the training dataset; None at evaluation.
        dataset_meta: Its metadata; None at evaluation.
    """

    def __init__(
        self,
        config: GuidedPolicyConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: Any = None,
    ) -> None:
        self.config = config
        self._observer = FieldObserver(config, dataset_stats, dataset_meta)
        # Whether plans are checked even if nothing acts on it: `plans` then tells of them.
        self.measures_plans = False
        self._said: set[str] = set()
        self._made: tuple[PotentialField, GuidanceSettings, Guide | None] | None = None
        self.reset()

    def __getstate__(self) -> dict[str, Any]:
        """The state for copies and pickles of the policy. A copy makes its own guide."""
        return {**vars(self), "_made": None}

    def reset(self) -> None:
        """Forgets the plans and actions of before. Must be called at the start of an episode."""
        self.plans: Plans | None = None  # of the last call; None if they were not checked
        self._robots = RobotPlaces()

    @property
    def support(self) -> Tensor | None:
        """``(B, T)`` how far the last plan's way to each action is inside the demonstrated region [nats].

        It is the smallest log density on that piece above the threshold for plans, negative outside. None if plans are not
        checked, and before the first one.
        """
        return None if self.plans is None else self.plans.action_support

    @property
    def demonstrations(self) -> DemonstratedActions | None:
        """The demonstrated actions of the last training batch; None before the first one."""
        return self._observer.demonstrations

    def observe(self, batch: dict[str, Any]) -> None:
        """Adds the actions of a training batch to the field in it, see `FieldObserver.observe`."""
        self._observer.observe(batch)

    @torch.compiler.disable  # the field may have to be fitted first
    def guide(self, batch: dict[str, Any], device: torch.device) -> Guide | None:
        """The configured guide over the batch's field; None with a guidance scale of 0.

        A guide is made once for a field and settings. It is kept until one of them changes.

        Args:
            batch: A batch that the policy's own preprocessor has made.
            device: The device of the actions to be guided.

        Raises:
            ValueError: If the batch holds no field, or one over other dimensions.
        """
        settings = self.config.guidance_settings
        if settings.scale == 0:
            return None
        field, made = fitted_field(batch.get(POTENTIAL_FIELD), self.config, device), self._made
        if made is None or made[0] is not field or made[1] != settings:
            made = self._made = field, settings, make_guide(field.prepared, settings)
        robots, guide = self._integrated(batch), made[2]
        if robots is None or guide is None:
            return guide
        return IntegratedGuide(guide, replace(robots, n_past=-self.config.action_delta_indices[0]))

    def _integrated(self, batch: dict[str, Any]) -> IntegratedActions | None:
        """The robots' integrated actions; None for a field over actions, or if there is no field.

        Raises:
            ValueError: If the batch has no observed state, or the field is over other positions.
        """
        config, demonstrations = self.config, batch.get(POTENTIAL_FIELD)
        if config.field_over != INTEGRATED or not isinstance(demonstrations, DemonstratedActions):
            return None
        if not len(demonstrations):
            return None
        states = batch.get(OBS_STATE)
        if states is None:
            raise ValueError(f"field_over=integrated needs {OBS_STATE}, got a batch without it")
        settings = config.field_settings
        return IntegratedActions.of_robots(
            demonstrations.integration(settings), settings, states, config.action_feature.shape[0]
        )

    def executed(self, action: Tensor) -> None:
        """Tells that a robot, or a batch of robots, is given an action ``(B, A)`` to execute [normalised]."""
        self._robots.executed(action)

    @torch.compiler.disable
    def begin(self, left_over: Tensor | None = None, inference_delay: int = 0) -> None:
        """A call begins, and the time that it takes counts from here.

        Args:
            left_over: ``([B,] T_left, A)`` actions of the last chunk that were not executed; None if no robot is moving on
                them.
            inference_delay: Number of those that are executed until the chunk is needed.

        Raises:
            ValueError: With real-time chunking and a field over integrated displacements: the robot moves on while the
                chunk is generated, and where its sums begin is not known.
        """
        config = self.config
        rtc = getattr(config, "rtc_config", None)
        is_rtc = left_over is not None or (rtc is not None and rtc.enabled)
        if is_rtc and config.field_over == INTEGRATED and (config.guidance_scale or config.checks_plans):
            raise ValueError(
                "field_over=integrated must be used without real-time chunking, got it switched on: use "
                "--inference.type=sync, or guidance_scale=0, max_plans=1 and on_unsupported=ignore"
            )
        self._robots.begin(left_over, inference_delay)

    def choose(
        self,
        batch: dict[str, Any],
        chunk: Tensor,
        draw_more: DrawMore | None,
    ) -> Tensor:
        """The chunks ``(B, T, A)`` to execute: checked, drawn again if need be, see ``max_plans`` in `GuidedConfig`.

        Args:
            batch: A batch that the policy's own preprocessor has made.
            chunk: ``(B, T, A)`` planned actions [normalised].
            draw_more: Draws further plans; None if there is no other plan.

        Raises:
            ValueError: If an action is not finite; if the field, or its calibration for plans, is missing although plans
                are to be checked; or if the batch has another size than that of the actions executed before.
            UnsupportedPlanError: See `react`.
        """
        config = self.config
        is_checked = config.checks_plans or self.measures_plans
        is_asked_for = config.on_unsupported != "ignore" or self.measures_plans
        is_free = not config.obstacles and OBS_OBSTACLES not in batch
        if torch.compiler.is_compiling() and POTENTIAL_FIELD not in batch and not is_asked_for and is_free:
            return require_finite(chunk, batch)  # one graph, for a guide that the caller made
        robots = self._integrated(batch) if is_checked or config.guidance_scale else None
        if robots is None:
            return self._choose(batch, chunk, draw_more, is_checked)
        return self._choose_integrated(batch, robots, chunk, draw_more, is_checked)

    @torch.compiler.disable
    def _choose_integrated(
        self,
        batch: dict[str, Any],
        robots: IntegratedActions,
        chunk: Tensor,
        draw_more: DrawMore | None,
        is_checked: bool,
    ) -> Tensor:
        """The same for displacements: their positions are judged. What is not changed stays as it is, bit for bit."""

        def limited(robots: IntegratedActions, chunk: Tensor) -> Tensor:
            return robots.within_limits(chunk) if self.config.guidance_scale else chunk

        def draw_positions(rows: Tensor, n_each: int) -> Tensor:
            assert draw_more is not None
            some = robots.for_rows(rows, n_each)
            return some.positions(limited(some, draw_more(rows, n_each)))

        if self.config.obstacle_rule != "ignore" and (self.config.obstacles or OBS_OBSTACLES in batch):
            raise ValueError(
                "obstacles need actions that are positions, got field_over=integrated: use obstacle_rule=ignore"
            )
        require_finite(chunk, batch)
        chunk = limited(robots, chunk)
        proposed = robots.positions(chunk)
        draw = None if draw_more is None else draw_positions
        chosen = self._choose(batch, proposed, draw, is_checked, places=robots.begun(chunk[:, 0]))
        is_same = (chosen == proposed).flatten(1).all(dim=1).reshape(-1, 1, 1)
        return torch.where(is_same, chunk, robots.displacements(chosen).to(chunk.dtype))

    @torch.compiler.disable  # whether other plans are drawn depends on the values
    def _choose(
        self,
        batch: dict[str, Any],
        chunk: Tensor,
        draw_more: DrawMore | None,
        is_checked: bool,
        places: Tensor | None = None,
    ) -> Tensor:
        """As `choose`, with places ``(B, A)`` where the robots are known to be; None if that is to be found out."""
        require_finite(chunk, batch)
        self.plans, observed, places = None, places, None
        check: WayCheck | None = self._plan_check(batch, chunk) if is_checked else None
        obstacles = self._known_obstacles(batch, chunk)
        if obstacles is not None and self.config.obstacle_rule == "pass":
            chunk, draw_more = obstacles.finished(chunk), obstacles.drawn_past(draw_more)
            check = ObstacleCheck(obstacles, check) if is_checked else None
        if check is not None:
            config, robots = self.config, self._robots
            known = self._places_of_robots(batch, chunk) if observed is None else observed
            places = chunk[:, 0] if known is None else known
            has_time = robots.budget.allows_another_pass(robots.n_steps, config.max_plans - 1)
            began = time.perf_counter()
            chunk, self.plans = choose_plans(
                check, places, chunk, config.max_plans, draw_more if has_time else None
            )
            if bool((self.plans.n_drawn > 1).any()):
                robots.budget.took(time.perf_counter() - began)
            if isinstance(check, ObstacleCheck):
                self.plans = replace(self.plans, clearance=check.guidance.clearances(chunk))
            chunk = react(config.on_unsupported, self.plans, chunk, known, robots.n_steps or 0)
        if obstacles is not None and self.config.obstacle_rule == "project":
            chunk = obstacles.projected(chunk)
        self._robots.end(chunk, places)
        return chunk

    def _plan_check(self, batch: dict[str, Any], chunk: Tensor) -> PlanCheck | None:
        """The check of plans; None, with a warning, if it is impossible and nothing that was asked for depends on it."""
        config, demonstrations = self.config, batch.get(POTENTIAL_FIELD)
        is_asked_for = config.on_unsupported != "ignore" or self.measures_plans
        try:
            field = fitted_field(demonstrations, config, chunk.device)
            threshold = cast(DemonstratedActions, demonstrations).plan_threshold(
                config.field_settings, chunk.shape[1], config.false_alarm_rate
            )
        except ValueError as error:
            if is_asked_for:
                raise
            self._warn_once("Plans are not checked, and none is drawn again: %s", error)
            return None
        if threshold.false_alarm_rate > config.false_alarm_rate:
            self._warn_once(
                "false_alarm_rate=%g cannot be kept with %d demonstrated plans: up to %.2g %% of plans as good as a "
                "demonstration are flagged.",
                config.false_alarm_rate,
                threshold.n_plans,
                100 * threshold.false_alarm_rate,
            )
        return PlanCheck(field, threshold.log_density, config.field_settings.action_dims)

    def _warn_once(self, message: str, *arguments: object) -> None:
        if message not in self._said:
            self._said.add(message)
            logger.warning(message, *arguments)

    def _known_obstacles(self, batch: dict[str, Any], chunk: Tensor) -> ObstacleGuidance | None:
        """What is done about obstacles in this call; None if none is known, or they are ignored."""
        config = self.config
        if not config.obstacles and OBS_OBSTACLES not in batch:
            return None
        dims, action_dim = config.field_settings.action_dims, config.action_feature.shape[0]
        obstacles = known_obstacles(config, batch, action_dim if dims is None else len(dims))
        if obstacles is None:
            return None
        units = getattr(batch.get(POTENTIAL_FIELD), "recorded_units", None)
        if units is None:
            raise ValueError(
                "obstacles need the units of the recorded actions, which the policy's own preprocessor knows; got a batch "
                "without it, or a normalisation of actions that is not one to one. obstacle_rule=ignore leaves them out"
            )
        units = units.on(dims, chunk.device)
        places = self._places_of_robots(batch, chunk)
        if places is not None:
            places = units.recorded(places if dims is None else places[:, list(dims)])
        guiding = config.guidance_scale > 0
        return ObstacleGuidance(
            config,
            obstacles.to(chunk.device),
            units,
            dims,
            places,
            fitted_field(batch.get(POTENTIAL_FIELD), config, chunk.device) if guiding else None,
            n_committed=self._robots.n_steps or 0,
        )

    def _places_of_robots(self, batch: dict[str, Any], chunk: Tensor) -> Tensor | None:
        """Where the robots are when they begin to execute a chunk, as actions ``(B, A)`` [normalised]; None if unknown.

        It is the last action that was executed. Where that is unknown, as in the first chunk, it is the observed state, and
        the chunk's first action in dimensions that the field does not cover. It is unknown without a state in the units of
        the actions.
        """
        places = self._robots(chunk)
        if places is not None:
            return places
        demonstrations, states = batch.get(POTENTIAL_FIELD), batch.get(OBS_STATE)
        first = chunk[:, 0]
        if not isinstance(demonstrations, DemonstratedActions) or states is None:
            return None
        states = states[:, -1] if states.ndim == 3 else states
        if not demonstrations.starts_at_state(self.config.field_settings) or states.shape != first.shape:
            self._warn_once(
                "%s has other dimensions than %s, or is not in its units: the way of a first plan begins at its first "
                "action, not where the robot is seen.",
                OBS_STATE,
                ACTION,
            )
            return None
        return seen_place(
            demonstrations.place_of(states.to(first)), first, self.config.field_settings.action_dims
        )
