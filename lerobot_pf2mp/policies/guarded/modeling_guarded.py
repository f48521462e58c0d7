# SPDX-License-Identifier: Apache-2.0
"""Any policy of LeRobot, or of a plug-in, guided and checked by a potential field."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn, Self

import torch
from lerobot.policies import PreTrainedPolicy
from lerobot.policies.factory import get_policy_class
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide
from lerobot_pf2mp.policies.batch_keys import POTENTIAL_FIELD
from lerobot_pf2mp.policies.checked_loading import (
    check_processors_of,
    require_all_weights,
    require_own_config,
)
from lerobot_pf2mp.policies.guarded.configuration_guarded import GuardedConfig
from lerobot_pf2mp.policies.guarded.generation import KNOWN_AT_THE_END, AtTheEnd, generation_of, replaced
from lerobot_pf2mp.policies.guarded.repeated_rows import repeated_queues, repeated_rows
from lerobot_pf2mp.policies.guided.field_guidance import FieldGuidance
from lerobot_pf2mp.policies.guided.integrated_actions import guide_for_rows
from lerobot_pf2mp.policies.obstacles.known_obstacles import OBS_OBSTACLES
from lerobot_pf2mp.policies.own_policy import OwnPolicy
from lerobot_pf2mp.policies.plans.plans import Plans

logger = logging.getLogger(__name__)

_PREFIX = "base."
# How a policy may call its own generation of chunks from `select_action`.
_CHUNK_METHODS = {"smolvla": "_get_action_chunk"}
# Policies whose generation continues their last one, so that none can be repeated.
_NOT_REPEATABLE = ("tdmpc",)
# Policies whose inputs are known to have a row for each robot. Others are asked for plans of the whole batch, one by one.
_WITH_ROWS = ("act", "diffusion", "multi_task_dit", "pi0", "pi05", "pi0_fast", "smolvla", "vqbet")
# Policies whose chunks have the time first, ``(T, B, A)``.
_TIME_FIRST = ("tdmpc",)


class GuardedPolicy(OwnPolicy, PreTrainedPolicy):
    """A policy, its base, with a potential field.

    Training the base also adds its actions to the field. At inference, its generation is guided (`generation` says where),
    and each chunk is checked and drawn again if it leaves the demonstrated region, where the base draws noise. With
    ``guidance_scale=0`` and ``max_plans=1`` actions and loss are the base's, bit for bit. A checkpoint's weights are in the
    base's own file format.

    Args:
        config: The policy's configuration.
        dataset_stats: Statistics of the training dataset; None at evaluation.
        dataset_meta: Its metadata; None at evaluation.
        base: The base; None makes a new one, which gets the other arguments.
        **kwargs: Other arguments of the base.
    """

    config_class = GuardedConfig
    name = "guarded"
    config: GuardedConfig

    def __init__(
        self,
        config: GuardedConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: Any = None,
        base: PreTrainedPolicy | None = None,
        **kwargs: Any,
    ) -> None:
        require_own_config(self, config)
        config.validate_features()
        super().__init__(config)
        if base is None:
            base_class = get_policy_class(config.base_config.type)
            base = base_class(
                config.base_config, dataset_stats=dataset_stats, dataset_meta=dataset_meta, **kwargs
            )
        self.base = base
        self.guidance = FieldGuidance(config, dataset_stats, dataset_meta)
        self._is_time_first = config.base_config.type in _TIME_FIRST
        # Whether the base would plan the same again, as it has been seen to do without drawing random numbers.
        self._draws_alike = config.base_config.type in _NOT_REPEATABLE
        # While the base selects an action: its function that generates chunks, and how many actions it executes of one.
        self._selecting: tuple[Callable[..., Tensor], int] | None = None
        self._has_planned = False  # since the last reset
        generation = generation_of(base)
        if isinstance(generation, AtTheEnd) and config.base_config.type not in KNOWN_AT_THE_END:
            logger.info(
                "How %s generates chunks is not known: they are guided when they are finished.",
                config.base_config.type,
            )

    def __getattr__(self, name: str) -> Any:
        """What this class lacks is the base's, for example its options of real-time chunking."""
        try:
            return super().__getattr__(name)
        except AttributeError:
            if name == "base" or name.startswith("__"):
                raise
            return getattr(self.base, name)

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: GuardedConfig | None = None,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: Any = None,
        **kwargs: Any,
    ) -> Self:
        """Loads a guarded checkpoint, or the base's own with a configuration that holds the base's.

        The base loads its weights in its own way.

        Raises:
            ValueError: If the processors would run foreign code (see `check_processors`), or weights are missing.
            ConfigError: If it is a checkpoint of another type.
        """
        revision = kwargs.get("revision")
        check_processors_of(pretrained_name_or_path, revision)
        of_the_hub = {key: kwargs[key] for key in ("cache_dir", "local_files_only", "token") if key in kwargs}
        if config is None:
            config = GuardedConfig.from_pretrained(pretrained_name_or_path, revision=revision, **of_the_hub)
        require_own_config(cls, config)
        base_class = get_policy_class(config.base_config.type)
        config.base_config.pretrained_path = Path(pretrained_name_or_path)  # as LeRobot's commands set it
        base = base_class.from_pretrained(
            pretrained_name_or_path,
            config=config.base_config,
            dataset_stats=dataset_stats,
            dataset_meta=dataset_meta,
            **kwargs,
        )
        require_all_weights(base, pretrained_name_or_path, revision, **of_the_hub)
        policy = cls(config, dataset_stats, dataset_meta, base=base)
        policy.to(config.device)
        policy.eval()
        return policy

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        if state_dict is not None:
            state_dict = {key.removeprefix(_PREFIX): value for key, value in state_dict.items()}
        # Where the base came from is of no use elsewhere.
        with replaced(self.config.base_config, "pretrained_path", None):
            self.base._save_pretrained(save_directory, state_dict)
            self.config._save_pretrained(save_directory)  # in place of the base's

    def wrap_with_peft(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuses adapters.

        Raises:
            ValueError: Always.
        """
        raise ValueError(
            "a guarded policy must be trained whole, got --peft options: train its base with them, merge the adapter into "
            "the weights, and guard the result with pf2mp-fit-field"
        )

    def get_optim_params(self) -> Any:
        """The base's."""
        return self.base.get_optim_params()

    def reset(self) -> None:
        """Forgets past observations and planned actions. Must be called at the start of an episode."""
        self.base.reset()
        self.guidance.reset()
        self._has_planned = False

    def supports_rtc(self) -> bool:
        """Whether the base does real-time chunking."""
        return self.base.supports_rtc()

    def forward(self, batch: dict[str, Any], *args: Any, **kwargs: Any) -> tuple[Tensor, dict | None]:
        """The loss of the base. In training it also adds the batch's actions to the potential field."""
        if self.training and torch.is_grad_enabled():
            self.guidance.observe(batch)
        return self.base.forward(_without_field(batch), *args, **kwargs)

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Any], *args: Any, **kwargs: Any) -> Tensor:
        """The base's chunk, ``(B, T, A)`` [normalised], guided, and chosen among up to ``max_plans``.

        Args:
            batch: As for the base, with the potential field.
            *args: Other arguments of the base.
            **kwargs: Other arguments of the base, for example those of real-time chunking. No plan is drawn again that
                would come too late.

        Raises:
            ValueError: If there is guidance, or a check that was asked for, and the batch holds no field, one over other
                dimensions, or one without demonstrated plans; or if an action is not finite.
            UnsupportedPlanError: With ``on_unsupported=stop``, if no plan stays in the demonstrated region.
        """
        self.guidance.begin(kwargs.get("prev_chunk_left_over"), kwargs.get("inference_delay") or 0)
        guide, inputs = self._guide(batch), _without_field(batch)
        generation = generation_of(self.base, kwargs.get("num_steps"))
        generate, n_executed = self._selecting or (self.base.predict_action_chunk, None)

        def draw(inputs: dict[str, Any], *args: Any, guide: Guide | None = guide, **kwargs: Any) -> Tensor:
            with generation.guided(guide):
                chunk = generate(dict(inputs), *args, **kwargs)  # some policies write into their batch
            if self._is_time_first:
                chunk = chunk.transpose(0, 1)
            return generation.finished(chunk[:, :n_executed], guide)

        chunk = draw(inputs, *args, **kwargs)

        def draw_more(rows: Tensor, n_each: int) -> Tensor:
            others = {key: value for key, value in kwargs.items() if key != "noise"}  # that of the first plan
            before = random_state(chunk.device)
            if self.config.base_config.type in _WITH_ROWS:
                selection = (rows, n_each, len(chunk))
                left_over = others.get("prev_chunk_left_over")
                if isinstance(left_over, Tensor) and left_over.ndim == 2:
                    others["prev_chunk_left_over"] = left_over.unsqueeze(0)  # it has no row for each robot
                with repeated_queues(self.base, *selection):
                    plans = draw(
                        repeated_rows(inputs, *selection),
                        guide=guide_for_rows(guide, rows, n_each),
                        **repeated_rows(others, *selection),
                    )
            else:
                plans = torch.cat([draw(inputs, **others)[rows].unsqueeze(1) for _ in range(n_each)], dim=1)
                plans = plans.flatten(0, 1)
            is_alike = _are_alike(plans.unflatten(0, (len(rows), n_each)), chunk[rows])
            self._draws_alike = is_alike and torch.equal(before, random_state(chunk.device))
            return plans

        chunk = self.guidance.choose(batch, chunk, None if self._draws_alike else draw_more)
        return chunk.transpose(0, 1) if self._is_time_first else chunk

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], *args: Any, **kwargs: Any) -> Tensor:
        """The base's action for the current step, ``(B, A)`` [normalised], from a chunk as above.

        Of the chunk, the actions that are executed are checked. Of ACT with temporal ensembling, and of policies that do
        not plan by `predict_action_chunk`, each action itself is guided and checked.
        """
        with self._planning(batch):
            action = self.base.select_action(_without_field(batch), *args, **kwargs)
        if not self._has_planned:
            self.guidance.begin()
            chunk = AtTheEnd().finished(action.unsqueeze(1), self._guide(batch))
            action = self.guidance.choose(batch, chunk, None).squeeze(1)
        self.guidance.executed(action)
        return action

    @property
    def plans(self) -> Plans | None:
        """What is known of the last plans; None if they were not checked."""
        return self.guidance.plans

    @property
    def support(self) -> Tensor | None:
        """``(B, T)`` how far the last chunk's way is inside the demonstrated region, see `FieldGuidance.support`."""
        return self.guidance.support

    def _guide(self, batch: dict[str, Any]) -> Guide | None:
        return self.guidance.guide(batch, next(self.parameters()).device)

    @contextmanager
    def _planning(self, batch: dict[str, Any]) -> Iterator[None]:
        """A block in which the base's `select_action` plans by `predict_action_chunk` of this class."""
        if getattr(self.config, "temporal_ensemble_coeff", None) is not None:
            yield  # only its mean over several chunks is executed
            return
        name = _CHUNK_METHODS.get(self.config.base_config.type, "predict_action_chunk")
        generate = getattr(self.base, name)
        ours = {key: value for key, value in batch.items() if key in (POTENTIAL_FIELD, OBS_OBSTACLES)}

        def planned(inputs: dict[str, Any], *args: Any, **kwargs: Any) -> Tensor:
            self._has_planned = True
            self._selecting = generate, self.config.n_action_steps
            try:
                return self.predict_action_chunk({**inputs, **ours}, *args, **kwargs)
            finally:
                self._selecting = None

        with replaced(self.base, name, planned):
            yield


def _without_field(batch: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in batch.items() if key != POTENTIAL_FIELD}


def random_state(device: torch.device) -> Tensor:
    """The state of the generator that draws random numbers on a device."""
    return torch.cuda.get_rng_state(device) if device.type == "cuda" else torch.get_rng_state()


def _are_alike(plans: Tensor, first: Tensor) -> bool:
    """Whether plans ``(F, n, T, A)`` are those ``(F, T, A)`` that were drawn before for the same observations."""
    return torch.allclose(plans, first.unsqueeze(1).expand_as(plans), atol=1e-4)
