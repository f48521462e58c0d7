# SPDX-License-Identifier: Apache-2.0
"""Configuration of the Diffusion Policy with Potential Field Guidance."""

import sys
from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.pretrained import PreTrainedPolicy

from lerobot_pf2mp.errors import ConfigError, reported_on_the_command_line
from lerobot_pf2mp.policies.guided.configuration_guided import GuidedConfig
from lerobot_pf2mp.policies.option_kinds import check_kinds_and_sizes


@PreTrainedConfig.register_subclass("dppf")
@dataclass
class DPPFConfig(GuidedConfig, DiffusionConfig):
    """Configuration of DPPF (Section V of the paper): LeRobot's Diffusion Policy with PF2MP's guidance.

    The arguments are those of LeRobot's `DiffusionConfig` and of `GuidedConfig`. Two defaults of the sampler differ from
    `DiffusionConfig`, as in the paper's comparison:

    Args:
        noise_scheduler_type: DDIM (deterministic, for few steps) or DDPM.
        num_inference_steps: Denoising steps N; None for all `num_train_timesteps`.
    """

    noise_scheduler_type: str = "DDIM"
    num_inference_steps: int | None = 5

    def __post_init__(self) -> None:
        """Validates the values.

        Raises:
            ConfigError: If one breaks its rule.
        """
        with reported_on_the_command_line():
            check_kinds_and_sizes(self)
            for name in (
                "horizon",
                "n_obs_steps",
                "n_action_steps",
                "num_train_timesteps",
                "n_groups",
                "kernel_size",
            ):
                if getattr(self, name) < 1:
                    raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
            super().__post_init__()
            self._validate_guidance()
            n_steps = self.num_inference_steps
            if n_steps is not None and not 1 <= n_steps <= self.num_train_timesteps:
                raise ValueError(
                    f"num_inference_steps must lie in 1 to num_train_timesteps={self.num_train_timesteps}, got {n_steps}"
                )

    def validate_features(self) -> None:
        """Checks the features, and that the field's dimensions are among the action's.

        Raises:
            ValueError: If they do not fit.
            ConfigError: If LeRobot's own `DiffusionPolicy` is opened with this configuration. It would be unguarded.
        """
        _refuse_other_policies()
        if not self.image_features and self.env_state_feature is None:
            raise ValueError(
                "a dppf policy's inputs must hold a camera or observation.environment_state, as LeRobot's Diffusion Policy, "
                f"got {list(self.input_features or {})}. Policies of type pf2mp take observation.state alone"
            )
        super().validate_features()
        self._validate_field_dims(self.action_feature)


def _refuse_other_policies() -> None:
    """Raises a ConfigError if the caller's caller is LeRobot's own policy, which says nothing of a field that it ignores.

    It has no place where a configuration could tell it. But it begins by checking the features of its configuration.
    """
    opening = sys._getframe(2).f_locals.get("self")
    if isinstance(opening, PreTrainedPolicy) and getattr(opening, "name", None) != "dppf":
        raise ConfigError(
            "a dppf checkpoint must be opened as a policy of type dppf, got diffusion: without the potential field it "
            "would be unguarded"
        )
