# SPDX-License-Identifier: Apache-2.0
"""Policies for the large maze, trained for a minute, so that their chunks run along its paths as trained ones do."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.policies import PreTrainedPolicy, make_pre_post_processors
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.factory import get_policy_class
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor, nn

from lerobot_pf2mp import DPPFConfig, FMPConfig, PF2MPConfig
from lerobot_pf2mp.dataset_tools.maze.maze_expert import MazeExpert
from lerobot_pf2mp.dataset_tools.writing.episodes import prepare
from lerobot_pf2mp.policies.guided.potential_field_step import PotentialFieldProcessorStep

SMALL, PAPER = (32, 64, 128), (512, 256, 128)  # channels of the U-Net's levels
NAMES = {SMALL: "small U-Net (32, 64, 128)", PAPER: "paper's U-Net (512, 256, 128)"}
HORIZON = 80
N_DEMONSTRATIONS = 1000
N_TRAINING_STEPS = 300

_CONFIGS: dict[str, Callable[..., Any]] = {
    "fmp": FMPConfig,
    "pf2mp": PF2MPConfig,
    "diffusion": DiffusionConfig,
    "dppf": DPPFConfig,
}
_GUIDED_TWIN = {"fmp": "pf2mp", "pf2mp": "pf2mp", "diffusion": "dppf", "dppf": "dppf"}


@dataclass(frozen=True)
class TrainedPolicy:
    """A policy with the small U-Net, and its processors.

    Args:
        policy: The policy.
        preprocessor: Its preprocessor, which holds the potential field.
        postprocessor: Its postprocessor.
    """

    policy: PreTrainedPolicy
    preprocessor: Any
    postprocessor: Any

    def save(self, folder: Path) -> None:
        """Writes a checkpoint."""
        for part in (self.policy, self.preprocessor, self.postprocessor):
            part.save_pretrained(folder)


@dataclass(frozen=True)
class Planner:
    """Plans one chunk from fixed observations and noise.

    Args:
        policy: The policy.
        batch: Observations, as its preprocessor makes them.
        noise: ``(B, HORIZON, 2)`` the prior sample.
    """

    policy: Any
    batch: dict[str, Any]
    noise: Tensor

    def __call__(self) -> Tensor:
        """The chunk, ``(B, HORIZON, 2)`` [normalised]."""
        return self.policy.predict_action_chunk(dict(self.batch), noise=self.noise)


@cache
def train(kind: str) -> TrainedPolicy:
    """A policy with the small U-Net, pf2mp or dppf, with a field over 3000 demonstrated actions."""
    torch.manual_seed(0)
    policy, preprocessor, postprocessor = _make(kind, SMALL, "cpu")
    policy.train()
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    demonstrations = _demonstrations()
    for _ in range(N_TRAINING_STEPS):
        chosen = torch.randint(N_DEMONSTRATIONS, (64,))
        loss, _ = policy(preprocessor({key: value[chosen] for key, value in demonstrations.items()}))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if hasattr(policy, "update"):
            policy.update()
    policy.eval()
    return TrainedPolicy(policy, preprocessor, postprocessor)


def make_planner(
    kind: str, down_dims: tuple[int, ...], batch_size: int, device: str = "cpu", **options: Any
) -> Planner:
    """A planner of a policy: fmp, pf2mp, diffusion or dppf, the unguided ones with the weights of the guided ones.

    Only the small U-Net is trained. In every other one all is computed, but its outputs are replaced by those of the small
    one, so that the field is asked about the same actions.

    Args:
        kind: The policy's type.
        down_dims: Channels of its U-Net's levels.
        batch_size: Observations at once.
        device: Where it plans.
        **options: Further options of the policy.
    """
    policy, preprocessor, _ = _make(kind, SMALL, device, **options)
    trained = train(_GUIDED_TWIN[kind])
    policy.load_state_dict(trained.policy.state_dict())
    _copy_field(trained.preprocessor, preprocessor)
    batch = preprocessor({key: _demonstrations()[key][:batch_size] for key in (OBS_STATE, OBS_ENV_STATE)})
    noise = torch.randn(batch_size, HORIZON, 2, generator=torch.Generator().manual_seed(0)).to(device)
    planner = Planner(policy.eval(), batch, noise)
    if down_dims == SMALL:
        return planner
    outputs = _record(planner)
    torch.manual_seed(0)
    planner = Planner(_make(kind, down_dims, device, **options)[0].eval(), batch, noise)
    replay(planner, outputs)
    return planner


def replay(planner: Planner, outputs: list[Tensor]) -> None:
    """Has the U-Net return these outputs, one after the other and again, once it has computed its own."""
    endless = cycle(outputs)
    _u_net(planner.policy).register_forward_hook(lambda *_: next(endless))


def _record(planner: Planner) -> list[Tensor]:
    outputs: list[Tensor] = []
    handle = _u_net(planner.policy).register_forward_hook(lambda *call: outputs.append(call[-1]))
    planner()
    handle.remove()
    return outputs


def _u_net(policy: Any) -> nn.Module:
    return policy.diffusion.unet if hasattr(policy, "diffusion") else policy.inference_network.unet


def _make(kind: str, down_dims: tuple[int, ...], device: str, **options: Any) -> tuple[Any, Any, Any]:
    config = _make_config(kind, down_dims, device, **options)
    statistics = {
        key: {"min": values.flatten(0, -2).amin(0), "max": values.flatten(0, -2).amax(0)}
        for key, values in _demonstrations().items()
        if key in (OBS_STATE, OBS_ENV_STATE, ACTION)
    }
    policy = get_policy_class(config.type)(config, dataset_stats=statistics).to(device)
    return policy, *make_pre_post_processors(config, dataset_stats=statistics)


def _make_config(kind: str, down_dims: tuple[int, ...], device: str, **options: Any) -> PreTrainedConfig:
    if _GUIDED_TWIN[kind] == "dppf":
        in_range = NormalizationMode.MIN_MAX
        options = {
            "n_obs_steps": 1,
            "normalization_mapping": {"STATE": in_range, "ENV": in_range, "ACTION": in_range},
            "prediction_type": "sample",
            "noise_scheduler_type": "DDIM",
            "num_inference_steps": 5,
            **options,
        }
    return _CONFIGS[kind](
        device=device,
        push_to_hub=False,
        horizon=HORIZON,
        n_action_steps=HORIZON,
        down_dims=down_dims,
        optimizer_lr=1e-3,
        input_features={
            OBS_STATE: PolicyFeature(FeatureType.STATE, (2,)),
            OBS_ENV_STATE: PolicyFeature(FeatureType.ENV, (2,)),
        },
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (2,))},
        **options,
    )


def _copy_field(source: Any, target: Any) -> None:
    steps = [
        step
        for pipeline in (source, target)
        for step in pipeline.steps
        if isinstance(step, PotentialFieldProcessorStep)
    ]
    if len(steps) == 2:
        steps[1].load_state_dict(steps[0].state_dict())


@cache
def _demonstrations() -> dict[str, Tensor]:
    """Whole demonstrations in the large maze: start and goal ``(N, 1, 2)``, and the chunk ``(N, HORIZON, 2)`` [m]."""
    expert = MazeExpert("large", action_noise=0.0, seed=0)
    frames = list(
        islice(prepare(expert.trajectories(), HORIZON, lambda _: False, Counter()), N_DEMONSTRATIONS)
    )
    return {
        OBS_STATE: torch.tensor([frame[OBS_STATE][:1].tolist() for frame in frames]),
        OBS_ENV_STATE: torch.tensor([frame[OBS_ENV_STATE][:1].tolist() for frame in frames]),
        ACTION: torch.tensor([frame[ACTION].tolist() for frame in frames]),
        f"{ACTION}_is_pad": torch.zeros(len(frames), HORIZON, dtype=torch.bool),
        "index": torch.arange(len(frames)) * HORIZON,
    }
