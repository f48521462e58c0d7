# SPDX-License-Identifier: Apache-2.0
"""Policies whose checkpoints are checked before they are loaded, by whichever command."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any, Self

import torch
from huggingface_hub import hf_hub_download
from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.policies.pretrained import (
    PreTrainedPolicy,
    load_model_as_safetensor,
    resolve_safetensors_device,
)
from safetensors import safe_open

from lerobot_pf2mp.errors import ConfigError
from lerobot_pf2mp.policies.processor_files import check_processors

# A tensor of at most so many weights is read to see whether it was loaded.
_FEW_WEIGHTS = 1_000_000


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
        check_processors_of(pretrained_name_or_path, kwargs.get("revision"))
        return super().from_pretrained(pretrained_name_or_path, *args, **kwargs)  # type: ignore[misc]

    @classmethod
    def _load_as_safetensor(cls, model: Any, model_file: str, map_location: str, strict: bool) -> Any:
        missing, _ = load_model_as_safetensor(
            model, model_file, strict=strict, device=resolve_safetensors_device(map_location)
        )
        _refuse_missing(missing, model_file, cls.name)
        return model


def check_processors_of(path: str | Path, revision: str | None = None) -> None:
    """`check_processors`, also of the main branch, from which LeRobot's commands take them whatever the revision."""
    check_processors(path, revision)
    if revision is not None:
        check_processors(path)


def require_all_weights(
    policy: PreTrainedPolicy, path: str | Path, revision: str | None = None, **of_the_hub: Any
) -> None:
    """Checks that a policy that is not ours got all its weights. LeRobot only logs those that are missing.

    Policies that load their weights in their own way may have other names in their files, and some of them go on with random
    weights if that fails. Of them, it checks that weights of the file are the policy's.

    Args:
        policy: The policy.
        path: The checkpoint from which it was loaded, a folder or a repository on the Hub.
        revision: Branch, tag or commit on the Hub.
        **of_the_hub: Other arguments of `hf_hub_download`.

    Raises:
        ValueError: If there is no file of weights, or weights are missing.
    """
    file = Path(path, SAFETENSORS_SINGLE_FILE)
    if not Path(path).is_dir():
        file = Path(hf_hub_download(str(path), SAFETENSORS_SINGLE_FILE, revision=revision, **of_the_hub))
    if not file.is_file():
        raise ValueError(f"the checkpoint must hold {SAFETENSORS_SINGLE_FILE}, got {path} without it")
    state = policy.state_dict()
    is_stock = all(
        getattr(type(policy), name).__func__ is getattr(PreTrainedPolicy, name).__func__
        for name in ("from_pretrained", "_load_as_safetensor")
    )
    with safe_open(file, framework="pt") as weights:
        found = set(weights.keys())
        if not is_stock:
            for key in sorted(found):
                mine = state.get(key, state.get(f"model.{key}"))
                if mine is not None and mine.ndim and mine.numel() <= _FEW_WEIGHTS:
                    theirs = weights.get_tensor(key).to(mine)
                    if torch.equal(theirs, mine) and bool((theirs != theirs.flatten()[0]).any()):
                        return  # a random or constant start would differ, or be of one value
            raise ValueError(
                f"none of the weights in {file} are those of the {policy.name} policy that was loaded"
            )
    there = {
        state[key].data_ptr() for key in found & set(state)
    }  # of tensors that share memory, one is in the file
    missing = [key for key, value in state.items() if key not in found and value.data_ptr() not in there]
    _refuse_missing(missing, str(file), str(policy.name))


def _refuse_missing(missing: Collection[str], file: str, name: str) -> None:
    if missing:
        shown = ", ".join(sorted(missing)[:3])
        raise ValueError(
            f"{file} must hold all weights of a {name} policy of this configuration, got a file without "
            f"{len(missing)} of them ({shown}{', ...' if len(missing) > 3 else ''})"
        )


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
