# SPDX-License-Identifier: Apache-2.0
"""Configuration of a guarded policy."""

from dataclasses import dataclass, fields
from functools import cache
from typing import TYPE_CHECKING, Any

import draccus
from lerobot.configs import PreTrainedConfig

from lerobot_pf2mp.errors import reported_on_the_command_line
from lerobot_pf2mp.policies.guided.configuration_guided import GuidedConfig
from lerobot_pf2mp.policies.option_kinds import check_kinds_and_sizes

# Guided already, or with a guided form of their own.
_OTHER_WAYS = {
    "fmp": "a policy of type pf2mp is its guided form",
    "pf2mp": "it is guided already",
    "dppf": "it is guided already",
    "guarded": "it is guarded already",
}
# Policies that LeRobot treats by their type, which a guarded one has not, or that need more than their saved files.
_NOT_TO_BE_HELD = {
    "groot": "LeRobot rebuilds its processors by the policy's type",
    "evo1": "LeRobot rebuilds its processors by the policy's type",
    "xvla": "LeRobot chooses the processors of its environments by the policy's type",
    "fastwam": "it starts from weights that it downloads by itself",
    "lingbot_va": "its plans go on from those before, so none can be repeated or corrected",
}
# Options of all policies that the base's network and processors read too.
_SHARED = ("input_features", "output_features", "device", "use_amp")


if TYPE_CHECKING:
    type UnguardedConfig = PreTrainedConfig
else:

    @dataclass
    class UnguardedConfig(draccus.ChoiceRegistry):
        """The configurations that `GuardedConfig` may hold, for the parser of options.

        It goes through all of them, and would never end if `GuardedConfig` were among its own choices.
        """

        @classmethod
        def get_known_choices(cls) -> dict[str, Any]:
            """All registered configurations of unguided policies by type."""
            known = PreTrainedConfig.get_known_choices()
            return {name: choice for name, choice in known.items() if name not in _OTHER_WAYS}

        @classmethod
        def get_choice_class(cls, name: str) -> Any:
            """The configuration of a type of policies."""
            return PreTrainedConfig.get_choice_class(name)

        @classmethod
        def get_choice_name(cls, subcls: type) -> str:
            """The type of a configuration."""
            return PreTrainedConfig.get_choice_name(subcls)

    UnguardedConfig.register(
        PreTrainedConfig
    )  # for isinstance, by which draccus writes the type of a configuration


@PreTrainedConfig.register_subclass("guarded")
@dataclass
class GuardedConfig(GuidedConfig, PreTrainedConfig):
    """Configuration of any policy of LeRobot, or of a plug-in, that a potential field guides and checks.

    It holds the configuration of that policy, `base`, and the options of `GuidedConfig`. Everything else, features, delta
    indices, normalisation, presets and the options of real-time chunking, is the base's, and an attribute that this class
    lacks is the base's too:

        lerobot-train --policy.type=guarded --policy.base.type=act --policy.base.chunk_size=80 --policy.max_plans=4 ...

    Args:
        base: The configuration of the policy that is guarded. It must plan chunks of absolute continuous actions.
        use_amp: Whether to compute in mixed precision; None for the base's choice.
    """

    base: UnguardedConfig | None = None
    use_amp: bool | None = None  # type: ignore[assignment]  # None: as the base

    def __post_init__(self) -> None:
        """Takes over what the base has been told, and validates the values.

        Raises:
            ConfigError: If there is no base, or one that cannot be guarded, or a value breaks its rule.
        """
        with reported_on_the_command_line():
            base = self.base
            if base is None:
                raise ValueError(
                    "a guarded policy needs the policy that it guards, got none: give --policy.base.type, for example act, "
                    "diffusion or smolvla, or guard a trained checkpoint with pf2mp-fit-field"
                )
            if base.type in _OTHER_WAYS:
                raise ValueError(
                    f"a guarded policy's base must be an unguided policy, got {base.type}: {_OTHER_WAYS[base.type]}"
                )
            if base.type in _NOT_TO_BE_HELD:
                raise ValueError(
                    f"a guarded policy cannot have the base {base.type}: {_NOT_TO_BE_HELD[base.type]}"
                )
            if base.use_peft or self.use_peft:
                raise ValueError(
                    f"a guarded policy's base must have whole weights, got {base.type} with an adapter (use_peft): merge "
                    "the adapter into the weights first"
                )
            given_steps: int = vars(self)["n_obs_steps"]
            if given_steps not in (1, base.n_obs_steps):
                raise ValueError(
                    f"n_obs_steps is an option of the base: give --policy.base.n_obs_steps, got {given_steps} and "
                    f"{base.n_obs_steps}"
                )
            self.n_obs_steps = base.n_obs_steps
            for name in _SHARED:
                given = getattr(self, name)
                setattr(self, name, getattr(base, name) if given in (None, {}) else given)  # and the base's
            super().__post_init__()
            check_kinds_and_sizes(self)
            self._validate_guidance()
            if base.action_delta_indices is None:
                raise ValueError(
                    f"a guarded policy's base must plan chunks of actions, got {base.type}, which gives one action at a time"
                )

    def __getattr__(self, name: str) -> Any:
        base = vars(self).get("base")
        if base is None or name.startswith("__"):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(base, name)

    def __setattr__(self, name: str, value: Any) -> None:
        base = vars(self).get("base")
        if name in _own_options() or base is None:
            super().__setattr__(name, value)
        if base is not None and (name in _SHARED or name not in _own_options()):
            setattr(base, name, value)

    @property
    def n_action_steps(self) -> int:
        """Number of a chunk's actions that are executed."""
        for name in ("n_action_steps", "action_chunk_size", "chunk_size"):
            if hasattr(self.base_config, name):
                return getattr(self.base_config, name)
        return len(self.base_config.action_delta_indices or [0])

    @property
    def observation_delta_indices(self) -> list | None:
        """The base's: which observations it sees."""
        return self.base_config.observation_delta_indices

    @property
    def action_delta_indices(self) -> list:
        """The base's: which actions a chunk has."""
        return self.base_config.action_delta_indices or []

    @property
    def reward_delta_indices(self) -> list | None:
        """The base's: which rewards it sees."""
        return self.base_config.reward_delta_indices

    def get_optimizer_preset(self) -> Any:
        """The base's optimiser."""
        return self.base_config.get_optimizer_preset()

    def get_scheduler_preset(self) -> Any:
        """The base's schedule of the learning rate."""
        return self.base_config.get_scheduler_preset()

    def validate_features(self) -> None:
        """Checks the features as the base does, and that the field's dimensions are among the action's.

        Raises:
            ValueError: If they do not fit.
        """
        self.base_config.validate_features()
        if self.action_feature is None:
            raise ValueError(
                f"a guarded policy's outputs must hold the action, got {list(self.output_features or {})}"
            )
        self._validate_field_dims(self.action_feature)

    @property
    def base_config(self) -> PreTrainedConfig:
        """The base's configuration."""
        assert self.base is not None  # `__post_init__` refuses it
        return self.base


@cache
def _own_options() -> frozenset[str]:
    return frozenset(field.name for field in fields(GuardedConfig))
