# SPDX-License-Identifier: Apache-2.0
"""Configuration of the Potential Field-Guided Flow Matching Policy."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_pf2mp.policies.fmp.configuration_fmp import FMPConfig
from lerobot_pf2mp.policies.guided.configuration_guided import GuidedConfig


@PreTrainedConfig.register_subclass("pf2mp")
@dataclass
class PF2MPConfig(GuidedConfig, FMPConfig):
    """Configuration of PF2MP (Section IV-B of the paper): FMP with a potential field that guides its inference.

    The arguments are those of `FMPConfig`, about network, flow and training, and of `GuidedConfig`, about guidance.
    """

    def _validate(self) -> None:
        super()._validate()
        self._validate_guidance()

    def validate_features(self) -> None:
        """Checks the features, and that the field's dimensions are among the action's.

        Raises:
            ValueError: If they do not fit.
        """
        super().validate_features()
        self._validate_field_dims(self.action_feature)
