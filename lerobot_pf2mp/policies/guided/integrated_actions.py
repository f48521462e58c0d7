# SPDX-License-Identifier: Apache-2.0
"""Displacements as positions: the running sum of a chunk's actions, from where the robot is observed.

A field needs positions. Where actions u are displacements of the end effector, the positions are

    p_k = p_0 + scale (u_1 + ... + u_k)                                 p_0 observed, scale [units of state per action]

in the dimensions of the field. They are affine in the chunk and, given p_0, the chunk is affine in them. So a flow over
chunks is a flow over positions, and guidance, checks and holds that know positions only apply to displacements.

Normalised positions have one unit and one origin for all policies of a state: the origin is the point that the state's
normalisation maps to 0, and one unit is what it makes of the dimension that it shrinks most, for MIN_MAX half of the widest
range. The unit is the same in all dimensions, so that distances are those of the room up to this factor, also where the
robot moves much farther in one direction than in others.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import torch
from lerobot.processor import NormalizerProcessorStep
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide
from lerobot_pf2mp.policies.guided.action_units import affine_of
from lerobot_pf2mp.policies.guided.field_settings import FieldSettings

if TYPE_CHECKING:
    from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions

# Largest share of the range of displacements that is rounding, where they are compared with their limits.
_ROUNDING = 1e-5


@dataclass(frozen=True, eq=False)
class Integration:
    """How normalised displacements and states become normalised positions, in the D dimensions of a field.

    Args:
        start: ``(D,)`` factors from a normalised state to its normalised position.
        step: ``(D,)`` factors from a normalised displacement to the step of the normalised position.
        rest: ``(D,)`` the step of the normalised position that a normalised displacement of 0 takes.
        low: ``(D,)`` smallest demonstrated displacement [normalised].
        high: ``(D,)`` largest demonstrated displacement [normalised].
    """

    start: Tensor
    step: Tensor
    rest: Tensor
    low: Tensor
    high: Tensor

    def tensor(self) -> Tensor:
        """``(5, D)`` float32, to be saved."""
        return torch.stack([getattr(self, field.name) for field in fields(self)]).float().cpu()

    @classmethod
    def of_tensor(cls, saved: Tensor) -> Integration:
        """The integration that was saved."""
        return cls(*saved.unbind(0))

    @classmethod
    def of(
        cls,
        normaliser: NormalizerProcessorStep,
        settings: FieldSettings,
        action_dim: int,
        action_stats: dict[str, Any],
    ) -> Integration:
        """The integration of a policy's actions.

        Args:
            normaliser: The step that normalises its actions and states.
            settings: The settings of its field.
            action_dim: Number of action dimensions.
            action_stats: Statistics of the dataset's actions, of which ``min`` and ``max`` are the limits.

        Raises:
            ValueError: If there is no ``observation.state``, or it has not the dimensions that the settings name.
        """
        dims = settings.action_dims or tuple(range(action_dim))
        state_dims = settings.state_dims or tuple(range(len(dims)))
        feature = (normaliser.features or {}).get(OBS_STATE)
        if feature is None:
            raise ValueError(
                f"field_over=integrated needs {OBS_STATE}, from which displacements are summed up, got a policy without it"
            )
        if len(state_dims) != len(dims) or max(state_dims) >= feature.shape[0]:
            raise ValueError(
                f"field_state_dims must be one dimension of {OBS_STATE} {tuple(feature.shape)} for each of the "
                f"{len(dims)} dimensions of the field, got {state_dims}"
            )
        of_action, of_state = affine_of(normaliser, ACTION, action_dim), affine_of(normaliser, OBS_STATE)
        factors, offsets = (row[list(dims)] for row in of_action)
        state_factors = of_state[0][list(state_dims)]
        unit = state_factors.abs().min()
        limits = torch.stack([torch.as_tensor(action_stats[name]).double() for name in ("min", "max")])
        low, high = (limits.reshape(2, -1)[:, list(dims)] * factors + offsets).sort(dim=0).values
        found = cls(
            start=unit / state_factors,
            step=settings.displacement_scale * unit / factors,
            rest=-settings.displacement_scale * unit * offsets / factors,
            low=low,
            high=high,
        )
        if not bool(found.tensor().isfinite().all()):
            raise ValueError(
                f"field_over=integrated needs finite statistics of {ACTION} and {OBS_STATE}, got others in the dataset"
            )
        return found

    def to(self, other: Tensor) -> Integration:
        """The same, of another tensor's device and kind."""
        return Integration(*(getattr(self, field.name).to(other) for field in fields(self)))


@dataclass(frozen=True, eq=False)
class IntegratedActions:
    """The positions to which the displacements of robots lead, and back.

    Args:
        integration: How displacements become positions.
        dims: ``(D,)`` int64, the action dimensions that are displacements of the field, on the device of the chunks.
        places: ``(B, D)`` where the robots are observed, p_0 [normalised positions].
        n_past: Number of a chunk's first actions that lie before the current step.
    """

    integration: Integration
    dims: Tensor
    places: Tensor
    n_past: int = 0

    @classmethod
    def of_robots(
        cls, integration: Integration, settings: FieldSettings, states: Tensor, action_dim: int
    ) -> IntegratedActions:
        """For robots whose states ``(B, [n_obs_steps,] S)`` are observed [normalised], from the current step on."""
        dims = settings.action_dims or tuple(range(action_dim))
        state_dims = settings.state_dims or tuple(range(len(dims)))
        now = _not_shortened((states[:, -1] if states.ndim == 3 else states).detach())
        if max(state_dims) >= now.shape[-1]:
            raise ValueError(
                f"field_state_dims must be below the dimension {now.shape[-1]} of {OBS_STATE}, got {state_dims}"
            )
        places = now[:, list(state_dims)] * integration.start.to(now)
        return cls(integration.to(places), torch.tensor(dims, device=now.device), places)

    def begun(self, first: Tensor) -> Tensor:
        """First actions ``(B, A)`` with the places of the robots in place of displacements."""
        placed = _not_shortened(first).clone()
        placed[:, self.dims] = self.places.to(placed)
        return placed

    def for_rows(self, rows: Tensor, n_each: int) -> IntegratedActions:
        """For some robots ``(F,)``, each `n_each` times, one after the other."""
        return replace(self, places=self.places[rows.to(self.places.device)].repeat_interleave(n_each, dim=0))

    def positions(self, chunk: Tensor) -> Tensor:
        """Chunks ``(B, T, A)`` with normalised positions in place of normalised displacements.

        Positions before the current step are those from which past displacements lead to p_0.
        """
        integration, dims = self.integration, self.dims
        placed = _not_shortened(chunk).clone()
        sums = (placed[..., dims] * integration.step + integration.rest).cumsum(dim=1)
        if self.n_past:
            sums = sums - sums[:, self.n_past - 1 : self.n_past]
        placed[..., dims] = (self.places.unsqueeze(1) + sums).to(placed)
        return placed

    def displacements(self, placed: Tensor) -> Tensor:
        """The inverse of `positions`, for chunks from the current step on ``(B, T, A)``."""
        integration, dims = self.integration, self.dims
        positions = placed[..., dims]
        steps = torch.diff(positions, dim=1, prepend=self.places.unsqueeze(1).to(positions))
        chunk = placed.clone()
        chunk[..., dims] = (steps - integration.rest) / integration.step
        return chunk

    def within_limits(self, chunk: Tensor) -> Tensor:
        """Chunks ``(B, T, A)`` from the current step on that follow the same positions with displacements in their limits.

        A displacement that is too large is cut, and the following ones catch up as far as they can. So what a robot would
        not execute is not planned. Chunks within the limits stay as they are.
        """
        integration, dims = self.integration, self.dims
        low, high = integration.low, integration.high
        slack = _ROUNDING * (high - low)
        given = _not_shortened(chunk)[..., dims]
        exceeds = ((given < low - slack) | (given > high + slack)).flatten(1).any(dim=1)
        if not bool(exceeds.any()):
            return chunk
        behind = torch.zeros_like(given[:, 0])  # what was cut so far, as a displacement
        cut = []
        for wanted in given.unbind(dim=1):
            cut.append((wanted + behind).clamp(low, high))
            behind = wanted + behind - cut[-1]
        limited = chunk.clone()
        limited[..., dims] = torch.stack(cut, dim=1).to(chunk.dtype)
        return torch.where(exceeds.reshape(-1, 1, 1), limited, chunk)


@dataclass(frozen=True, eq=False)
class IntegratedGuide:
    """A guide over positions that bends chunks of displacements.

    Its offset of the positions is handed back as an offset of the displacements: the step from one position's offset to the
    next one's. Actions before the current step are done, and stay as they are.

    Args:
        guide: The guide over chunks with positions in place of displacements.
        actions: The robots' integrated actions.
    """

    guide: Guide
    actions: IntegratedActions

    def __call__(self, x_t: Tensor, x_next: Tensor, x_1: Tensor, dt: float) -> Tensor:
        """The guided step from the unguided one, all ``(B, T, A)`` [normalised displacements]."""
        actions, dims = self.actions, self.actions.dims
        before = actions.positions(x_next)
        after = self.guide(actions.positions(x_t), before, actions.positions(x_1), dt)
        offsets = (after - before)[..., dims]  # (B, T, D)
        offsets[:, : actions.n_past] = 0.0
        steps = torch.diff(offsets, dim=1, prepend=torch.zeros_like(offsets[:, :1]))
        guided = x_next.clone()
        guided[..., dims] += (steps / actions.integration.step).to(x_next.dtype)
        return guided

    def for_rows(self, rows: Tensor, n_each: int) -> IntegratedGuide:
        """For some robots ``(F,)``, each `n_each` times, one after the other."""
        return replace(self, actions=self.actions.for_rows(rows, n_each))

    @property
    def from_now_on(self) -> IntegratedGuide:
        """For chunks that begin at the current step."""
        return replace(self, actions=replace(self.actions, n_past=0))


def _not_shortened(values: Tensor) -> Tensor:
    """The same numbers, at least float32: sums of shorter ones lose what the last actions add."""
    return values.to(torch.promote_types(values.dtype, torch.float32))


def guide_for_rows(guide: Guide | None, rows: Tensor, n_each: int) -> Guide | None:
    """The guide of some robots of a batch, each several times. A guide over actions is the same for all."""
    return guide.for_rows(rows, n_each) if isinstance(guide, IntegratedGuide) else guide


def guide_from_now_on(guide: Guide) -> Guide:
    """The guide for chunks that begin at the current step. A guide over actions is the same for all."""
    return guide.from_now_on if isinstance(guide, IntegratedGuide) else guide


def observe_integrated(
    demonstrations: DemonstratedActions,
    integration: Integration,
    displacements: Tensor,
    is_pad: Tensor | None,
    frames: Tensor | None,
    episodes: Tensor | None,
    states: Tensor,
    *,
    settings: FieldSettings,
    **options: Any,
) -> None:
    """Adds the positions to which demonstrated displacements lead to the sample of a field.

    Args:
        demonstrations: The sample.
        integration: How displacements become positions.
        displacements: ``(B, T, A)`` chunks from the current step on [normalised].
        is_pad: ``(B, T)`` true where a chunk reaches beyond its episode.
        frames: ``(B,)`` index in the dataset of the current step.
        episodes: ``(B,)`` episode numbers.
        states: ``(B, S)`` observed states at the current step [normalised].
        settings: The settings of the sample.
        **options: Other arguments of `DemonstratedActions.observe`.
    """
    action_dim = displacements.shape[-1]
    robots = IntegratedActions.of_robots(integration, settings, states, action_dim)
    demonstrations.observe(
        robots.positions(displacements),
        is_pad,
        frames,
        episodes,
        settings=settings,
        states=robots.begun(displacements[:, 0]),
        places=torch.stack([torch.ones(action_dim), torch.zeros(action_dim)]),  # they are positions already
        integration=integration,
        **options,
    )
