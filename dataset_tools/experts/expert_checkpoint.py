# SPDX-License-Identifier: Apache-2.0
"""Saves experts in a folder and loads them, without pickles.

``expert.json`` holds the settings, the number of steps and the name of a folder beside it, with ``policy.safetensors``
(weights; for SAC the entropy coefficient too), ``optimizers.pt`` (read with ``weights_only``) and for SAC
``replay_buffer.npz``. ``expert.json`` is replaced only after that folder is complete, so it always names a complete folder.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file

from lerobot_pf2mp.dataset_tools.experts.expert_settings import ExpertSettings
from lerobot_pf2mp.errors import explained
from lerobot_pf2mp.process.atomic_files import file_written_beside

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import BasePolicy

    from lerobot_pf2mp.dataset_tools.experts.expert_algorithms import PenalisingReplayBuffer

EXPERT_FILE = "expert.json"
_STEPS = "steps_"
_POLICY, _OPTIMIZERS, _BUFFER = "policy.safetensors", "optimizers.pt", "replay_buffer.npz"
_LOG_ENT_COEF = "log_ent_coef"
_ROWS = ("actions", "rewards", "dones", "timeouts", "ep_start", "ep_length", "touching")


@dataclass(frozen=True)
class ExpertCheckpoint:
    """An expert in a folder.

    Args:
        folder: The folder.
        settings: Its settings.
        n_steps: Environment steps that it was trained for.
    """

    folder: Path
    settings: ExpertSettings
    n_steps: int

    @classmethod
    def read(cls, folder: Path) -> ExpertCheckpoint:
        """Reads the settings of the expert in a folder.

        Raises:
            FileNotFoundError: If there is no expert.
            ValueError: If it cannot be read.
        """
        path = folder / EXPERT_FILE
        if not path.is_file():
            raise FileNotFoundError(
                f"{folder} must be a folder written by pf2mp-train-expert, it holds no {EXPERT_FILE}"
            )
        with explained(f"{path} cannot be read"):
            content = json.loads(path.read_text(encoding="utf-8"))
            return cls(folder, ExpertSettings.from_plain(content["settings"]), int(content["n_steps"]))

    @property
    def files(self) -> Path:
        """The folder of its arrays."""
        return self.folder / f"{_STEPS}{self.n_steps}"

    @property
    def description(self) -> str:
        """A description of the expert, as the beginning of a sentence."""
        settings = self.settings
        algorithm = {"ppo": "PPO", "sac_her": "SAC with hindsight experience replay"}[settings.algo]
        penalty = settings.collision_penalty and f", collision penalty {settings.collision_penalty:g}"
        return (
            f"An expert trained by {algorithm} for {self.n_steps} steps ({settings.reward} reward{penalty or ''}, "
            f"training seed {settings.seed})"
        )

    def write(self, algorithm: BaseAlgorithm) -> None:
        """Writes an algorithm's state. The earlier state in the folder is removed when this one is complete."""
        try:
            self._write_files(algorithm)
            with file_written_beside(self.folder / EXPERT_FILE) as partial:
                content = {"settings": self.settings.plain, "n_steps": self.n_steps}
                partial.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        except BaseException:
            shutil.rmtree(self.files, ignore_errors=True)
            raise
        for other in self.folder.glob(f"{_STEPS}*"):
            if other != self.files:
                shutil.rmtree(other)

    def _write_files(self, algorithm: BaseAlgorithm) -> None:
        shutil.rmtree(self.files, ignore_errors=True)  # left by a call that was killed
        self.files.mkdir(parents=True)
        parameters = algorithm.get_parameters()
        weights = parameters.pop("policy")
        log_ent_coef = getattr(algorithm, _LOG_ENT_COEF, None)  # SAC's
        if log_ent_coef is not None:
            weights[_LOG_ENT_COEF] = log_ent_coef.detach()
        # Cloned, because PPO's policy lists the same tensors under several names.
        save_file({name: each.cpu().clone() for name, each in weights.items()}, self.files / _POLICY)
        torch.save(parameters, self.files / _OPTIMIZERS)
        buffer = getattr(algorithm, "replay_buffer", None)
        if buffer is not None:
            np.savez(self.files / _BUFFER, allow_pickle=False, **_arrays_of(buffer))

    def load_into(self, algorithm: BaseAlgorithm) -> None:
        """Loads the saved state into an algorithm with the same settings.

        Raises:
            OSError: If a file is missing.
            ValueError: If one is damaged.
        """
        with explained(f"{self.files} cannot be loaded"):
            weights = load_file(self.files / _POLICY)
            log_ent_coef = getattr(algorithm, _LOG_ENT_COEF, None)
            if log_ent_coef is not None:
                log_ent_coef.data.copy_(weights.pop(_LOG_ENT_COEF))
            parameters: dict[str, Any] = torch.load(
                self.files / _OPTIMIZERS, map_location="cpu", weights_only=True
            )
            algorithm.set_parameters(parameters | {"policy": weights})
            buffer = getattr(algorithm, "replay_buffer", None)
            if buffer is not None:
                with np.load(self.files / _BUFFER, allow_pickle=False) as arrays:
                    _fill(buffer, dict(arrays))
            algorithm.num_timesteps = self.n_steps

    def load_policy(self) -> BasePolicy:
        """Loads only the policy, on the CPU.

        Raises:
            ImportError: If Stable-Baselines3 is missing.
            OSError: If the file is missing.
            ValueError: If it is damaged.
        """
        from lerobot_pf2mp.dataset_tools.experts.expert_algorithms import make_policy

        policy = make_policy(self.settings)
        with explained(f"{self.files} cannot be loaded"):
            weights = load_file(self.files / _POLICY)
            weights.pop(_LOG_ENT_COEF, None)
            policy.load_state_dict(weights)
        policy.set_training_mode(False)
        return policy


def _columns(buffer: PenalisingReplayBuffer) -> dict[str, np.ndarray]:
    """The buffer's arrays ``(buffer_size, n_envs, ...)`` by name."""
    columns = {name: getattr(buffer, name) for name in _ROWS}
    for name in ("observations", "next_observations"):
        columns |= {f"{name}.{key}": array for key, array in getattr(buffer, name).items()}
    return columns


def _arrays_of(buffer: PenalisingReplayBuffer) -> dict[str, Any]:
    arrays: dict[str, Any] = {name: column[: buffer.size()] for name, column in _columns(buffer).items()}
    return arrays | {"pos": buffer.pos, "full": buffer.full, "current_ep_start": buffer._current_ep_start}


def _fill(buffer: PenalisingReplayBuffer, arrays: dict[str, np.ndarray]) -> None:
    buffer.pos, buffer.full = int(arrays["pos"]), bool(arrays["full"])
    buffer._current_ep_start[:] = arrays["current_ep_start"]
    for name, column in _columns(buffer).items():
        column[: buffer.size()] = arrays[name]
