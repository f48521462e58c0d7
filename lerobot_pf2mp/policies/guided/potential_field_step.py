# SPDX-License-Identifier: Apache-2.0
"""The potential field as a preprocessing artifact: one step of the policy's preprocessor, saved beside the weights.

The step gives one object, its `DemonstratedActions`, to the policy in every batch. The policy writes to it in training and
reads from it at inference. Only the step saves and loads it:

                     preprocessor                                          policy
        batch ------> normaliser -> PotentialFieldProcessorStep --batch["potential_field"]--> FieldGuidance
                                         |  owns                                  |
                                         v                                        |
                              DemonstratedActions <---- observe(actions) ---------+   training
                                         |        ----- field(settings) --------> |   inference
                       save_pretrained   |                                        v
                       load              v                              guide of the flow, check of the chunk
                policy_preprocessor_step_<i>_potential_field.safetensors

LeRobot saves, reloads and publishes preprocessors with every checkpoint, so the field needs no extra file format, option
or command. The step comes after the normaliser, because the policy generates normalised actions.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from torch import Tensor

from lerobot_pf2mp.policies.batch_keys import POTENTIAL_FIELD
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.field_settings import FieldSettings
from lerobot_pf2mp.policies.guided.relative_actions import refuse_relative_actions_beside
from lerobot_pf2mp.policies.obstacles.recorded_units import units_beside


@ProcessorStepRegistry.register("potential_field")
class PotentialFieldProcessorStep(ProcessorStep):
    """Gives the demonstrated actions and their potential field to the policy, and saves them with the preprocessor.

    Args:
        settings: Fields of `FieldSettings`, as keyword arguments.
    """

    def __init__(self, **settings: Any) -> None:
        self.demonstrations = DemonstratedActions(FieldSettings(**settings))
        self._has_been_called = False

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """The transition with the demonstrations under the complementary key `POTENTIAL_FIELD`.

        Raises:
            ValueError: If another step of the preprocessor makes actions relative, at the first call.
        """
        if not self._has_been_called:
            refuse_relative_actions_beside(self)
            self.demonstrations.recorded_units = units_beside(self)
            self._has_been_called = True
        transition = transition.copy()
        complementary_data = dict(transition.get(TransitionKey.COMPLEMENTARY_DATA) or {})
        complementary_data[POTENTIAL_FIELD] = self.demonstrations
        transition[TransitionKey.COMPLEMENTARY_DATA] = complementary_data
        return transition

    def get_config(self) -> dict[str, Any]:
        """The settings, for the preprocessor's JSON file."""
        return asdict(self.demonstrations.settings)

    def state_dict(self) -> dict[str, Tensor]:
        """The state of the demonstrations. Fits the field first if training has changed them."""
        return self.demonstrations.state_dict()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restores the state of the demonstrations."""
        self.demonstrations.load_state_dict(state)

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """The features, unchanged."""
        return features
