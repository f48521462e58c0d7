# SPDX-License-Identifier: Apache-2.0
"""Policies whose checkpoints are checked before they are loaded, by whichever command."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

from lerobot.policies.pretrained import load_model_as_safetensor, resolve_safetensors_device

from lerobot_pf2mp.errors import ConfigError
from lerobot_pf2mp.policies.processor_files import check_processors


class CheckedLoading:
    """A mixin that refuses what LeRobot's loading lets pass. It must come before LeRobot's policy class.

    LeRobot's commands load the policy first, then its processors. So the processors are looked at here.
    """

    config_class: type
    name: str

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, *args: Any, **kwargs: Any) -> Self:
        """Loads a checkpoint as LeRobot's `PreTrainedPolicy` does.

        Raises:
            ValueError: If its processors would run foreign code (see `check_processors`), or weights are missing.
            ConfigError: If it is a checkpoint of another type.
        """
        revision = kwargs.get("revision")
        check_processors(pretrained_name_or_path, revision)
        if revision is not None:
            check_processors(pretrained_name_or_path)  # LeRobot's commands take them from the main branch
        return super().from_pretrained(pretrained_name_or_path, *args, **kwargs)  # type: ignore[misc]

    @classmethod
    def _load_as_safetensor(cls, model: Any, model_file: str, map_location: str, strict: bool) -> Any:
        missing, _ = load_model_as_safetensor(
            model, model_file, strict=strict, device=resolve_safetensors_device(map_location)
        )
        if missing:
            shown = ", ".join(sorted(missing)[:3])
            raise ValueError(
                f"{model_file} must hold all weights of a {cls.name} policy of this configuration, got a file without "
                f"{len(missing)} of them ({shown}{', ...' if len(missing) > 3 else ''})"
            )
        return model


def require_own_config(policy: Any, config: Any) -> None:
    """Checks that a policy is opened with a configuration of its own type, not with that of a guided or unguided sibling.

    Raises:
        ConfigError: If it is not. It names the right type.
    """
    if type(config) is not policy.config_class:
        raise ConfigError(
            f"a {config.type} checkpoint must be opened as a policy of type {config.type}, got {policy.name}: without "
            "the potential field it would be unguarded, and with it there is none"
        )
