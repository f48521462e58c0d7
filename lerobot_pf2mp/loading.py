# SPDX-License-Identifier: Apache-2.0
"""Loads a policy with its processors, field included, for notebooks and scripts."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy, make_pre_post_processors
from lerobot.policies.factory import get_policy_class
from lerobot.processor import DeviceProcessorStep, PolicyAction, PolicyProcessorPipeline
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_pf2mp.errors import explained
from lerobot_pf2mp.policies.guided.configuration_guided import GuidedConfig
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.fitted_field import fitted_field
from lerobot_pf2mp.policies.guided.potential_field_step import PotentialFieldProcessorStep
from lerobot_pf2mp.policies.guided.relative_actions import refuse_relative_actions
from lerobot_pf2mp.policies.processor_files import check_processors, trusting
from lerobot_pf2mp.potential_field import PotentialField


def load_policy(
    path: str | Path,
    *,
    revision: str | None = None,
    device: str | None = None,
    trust: Sequence[str] = (),
    **overrides: Any,
) -> tuple[
    PreTrainedPolicy,
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Loads a checkpoint: the policy in evaluation mode, its preprocessor and its postprocessor.

    Args:
        path: A checkpoint's ``pretrained_model`` folder, or a repository on the Hub.
        revision: Branch, tag or commit on the Hub.
        device: Device of the policy, for example ``cuda``; None for the best available one.
        trust: Classes of processor steps, by their full names, that may be imported although they are not registered.
        **overrides: Fields of the policy's configuration to change, for example ``guidance_scale=0.4``.

    Returns:
        The policy, the preprocessor and the postprocessor.

    Raises:
        FileNotFoundError: If the path is neither a folder nor the name of a repository.
        OSError: If the checkpoint cannot be read or reached.
        ValueError: If an option does not exist or cannot have its value, a file is damaged, a processor step is neither
            registered nor trusted, guidance is on without a potential field, or actions are relative beside one.
    """
    with trusting(trust):
        return _load(path, revision, device, overrides)


def _load(
    path: str | Path, revision: str | None, device: str | None, overrides: dict[str, Any]
) -> tuple[PreTrainedPolicy, PolicyProcessorPipeline, PolicyProcessorPipeline]:
    config = load_config(path, revision=revision, device=device, **overrides)
    path = str(config.pretrained_path)
    where = f"the checkpoint {path}{f' at revision {revision}' if revision else ''}"
    with explained(f"{where} is not loaded"):
        check_processors(path, revision, must_exist=True)
    with explained(f"the weights of {where} cannot be loaded"):
        policy = get_policy_class(config.type).from_pretrained(path, config=config, revision=revision)
    with explained(f"the processors of {where} cannot be loaded"):
        preprocessor, postprocessor = make_pre_post_processors(
            config,
            pretrained_path=path,
            pretrained_revision=revision,
            preprocessor_overrides={"device_processor": {"device": config.device}},
        )
        if any(isinstance(step, PotentialFieldProcessorStep) for step in preprocessor.steps):
            refuse_relative_actions(preprocessor.steps)
        if isinstance(config, GuidedConfig) and config.guidance_scale > 0:
            loaded_field(config, preprocessor)
    return policy, preprocessor, postprocessor


def loaded_field(
    config: Any, preprocessor: PolicyProcessorPipeline[dict[str, Any], dict[str, Any]]
) -> PotentialField:
    """The potential field of a guided policy's preprocessor.

    Args:
        config: The policy's configuration.
        preprocessor: Its preprocessor.

    Raises:
        ValueError: If there is no field, it is not fitted, or it covers other dimensions than the policy's.
    """
    return fitted_field(loaded_demonstrations(preprocessor), config)


def loaded_demonstrations(
    preprocessor: PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
) -> DemonstratedActions:
    """The demonstrated actions that a guided policy's preprocessor holds.

    Args:
        preprocessor: The preprocessor.

    Raises:
        ValueError: If it has no step that holds them.
    """
    for step in preprocessor.steps:
        if isinstance(step, PotentialFieldProcessorStep):
            return step.demonstrations
    raise ValueError(
        "guidance needs the potential field, got a preprocessor without its step: it belongs to another policy"
    )


def load_processors(
    config: PreTrainedConfig, path: str | Path, revision: str | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """A checkpoint's preprocessor and postprocessor, on the CPU.

    Args:
        config: The checkpoint's configuration.
        path: A ``pretrained_model`` folder or a repository on the Hub.
        revision: Branch, tag or commit on the Hub.

    Raises:
        ValueError: If they are missing, damaged, or would run foreign code.
    """
    check_processors(str(path), revision, must_exist=True)
    return make_pre_post_processors(
        config,
        pretrained_path=str(path),
        pretrained_revision=revision,
        preprocessor_overrides={"device_processor": {"device": "cpu"}},
    )


def save_processors(processors: Sequence[PolicyProcessorPipeline], folder: Path, device: str) -> None:
    """Saves a policy's processors, which will move observations to a device."""
    for step in processors[0].steps:
        if isinstance(step, DeviceProcessorStep):
            step.device = device
    for processor in processors:
        processor.save_pretrained(folder)


def load_config(
    path: str | Path, *, revision: str | None = None, device: str | None = None, **overrides: Any
) -> PreTrainedConfig:
    """Loads a checkpoint's configuration. The arguments and errors are those of `load_policy`."""
    _register_plugins()
    path = Path(path).expanduser()
    is_repository_name = len(path.parts) == 2 and not path.is_absolute()
    if not path.is_dir() and not is_repository_name:
        raise FileNotFoundError(
            f"path must be a checkpoint's pretrained_model folder or a repository user/name, got {path}"
        )
    if device is not None:
        overrides["device"] = device
    options = [
        f"--{name}={value if isinstance(value, str) else json.dumps(value)}"
        for name, value in overrides.items()
    ]
    at_revision = f" at revision {revision}" if revision else ""
    with explained(f"the checkpoint {path}{at_revision} cannot be loaded"):
        config = PreTrainedConfig.from_pretrained(path, revision=revision)
        names = [field.name for field in fields(config)]
        for name in overrides:
            if name not in names:
                raise ValueError(f"a {config.type} policy's option must be one of {names}, got {name!r}")
        if options:
            config = PreTrainedConfig.from_pretrained(path, revision=revision, cli_overrides=options)
    # LeRobot leaves this empty. It would then create new processors, without statistics and without the field.
    config.pretrained_path = path
    return config


@cache
def _register_plugins() -> None:
    """Makes the policies of other installed plug-ins known, as LeRobot's own commands do."""
    register_third_party_plugins()
