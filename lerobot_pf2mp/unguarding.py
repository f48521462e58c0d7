# SPDX-License-Identifier: Apache-2.0
"""Gives back the policy that a guided checkpoint was made from."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class

from lerobot_pf2mp.errors import explained
from lerobot_pf2mp.loading import load_config, load_processors, save_processors
from lerobot_pf2mp.policies.checked_loading import require_all_weights
from lerobot_pf2mp.policies.guarded.configuration_guarded import GuardedConfig
from lerobot_pf2mp.policies.guided.potential_field_step import PotentialFieldProcessorStep
from lerobot_pf2mp.process.atomic_files import written_beside

UNGUIDED_TYPES = {"pf2mp": "fmp", "dppf": "diffusion"}


def unguard(
    checkpoint: str | Path, output_dir: Path, *, revision: str | None = None, overwrite: bool = False
) -> PreTrainedConfig:
    """Writes a checkpoint with the same weights and no potential field.

    Args:
        checkpoint: A ``pretrained_model`` folder or a repository on the Hub, of a guided policy.
        output_dir: The folder to write.
        revision: Branch, tag or commit on the Hub.
        overwrite: Whether a checkpoint already at `output_dir` is replaced.

    Returns:
        The new policy's configuration.

    Raises:
        ValueError: If the policy is not a guided one.
        OSError: If the checkpoint cannot be read.
        FileExistsError: If `output_dir` exists and `overwrite` is false.
    """
    guided = load_config(checkpoint, revision=revision)
    plain = _plain_config(guided)
    device, plain.device = plain.device, "cpu"
    with written_beside(
        output_dir, overwrite, kind="checkpoint", mark="config.json", option="--output_dir"
    ) as new:
        with explained(f"the checkpoint {checkpoint} cannot be loaded"):
            policy = get_policy_class(plain.type).from_pretrained(
                str(checkpoint), config=plain, revision=revision
            )
            require_all_weights(policy, checkpoint, revision)
            preprocessor, postprocessor = load_processors(guided, checkpoint, revision)
        preprocessor.steps = [
            step for step in preprocessor.steps if not isinstance(step, PotentialFieldProcessorStep)
        ]
        plain.device, plain.pretrained_path = device, None
        with explained(f"the checkpoint {output_dir} cannot be written"):
            policy.save_pretrained(new)
            save_processors((preprocessor, postprocessor), new, str(device))
    return plain


def _plain_config(config: PreTrainedConfig) -> PreTrainedConfig:
    """The configuration of the policy without guidance."""
    if isinstance(config, GuardedConfig):
        return config.base_config
    if config.type not in UNGUIDED_TYPES:
        raise ValueError(
            f"the checkpoint's type must be one of {[*UNGUIDED_TYPES, 'guarded']}, got {config.type!r}"
        )
    plain_class = PreTrainedConfig.get_choice_class(UNGUIDED_TYPES[config.type])
    names = [field.name for field in fields(plain_class) if field.init]
    return plain_class(**{name: getattr(config, name) for name in names})
