# SPDX-License-Identifier: Apache-2.0
"""Small checkpoints of every kind of policy for a maze, with weights drawn from a seed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.factory import get_policy_class

from lerobot_pf2mp import DPPFConfig, FMPConfig, GuardedConfig, PF2MPConfig
from lerobot_pf2mp.policies.guided.potential_field_step import PotentialFieldProcessorStep

STATE, ENV, ACTION = "observation.state", "observation.environment_state", "action"
HALF_WIDTH = 1.5  # of what the untrained policies' actions and observations are normalised to [m]
FEATURES: dict[str, Any] = {
    "device": "cpu",
    "n_action_steps": 4,
    "input_features": {
        STATE: PolicyFeature(FeatureType.STATE, (2,)),
        ENV: PolicyFeature(FeatureType.ENV, (2,)),
    },
    "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (2,))},
}
U_NET: dict[str, Any] = {
    **FEATURES,
    "horizon": 8,
    "down_dims": (8, 16),
    "diffusion_step_embed_dim": 16,
    "num_inference_steps": 2,
}
DENOISING: dict[str, Any] = {**U_NET, "noise_scheduler_type": "DDIM", "num_train_timesteps": 20}
TRANSFORMER: dict[str, Any] = {
    **FEATURES,
    "chunk_size": 8,
    "dim_model": 16,
    "dim_feedforward": 16,
    "n_heads": 2,
    "n_encoder_layers": 1,
    "use_vae": False,
    "pretrained_backbone_weights": None,
}
MAKE_CONFIG: dict[str, Callable[[], PreTrainedConfig]] = {
    "fmp": lambda: FMPConfig(**U_NET),
    "pf2mp": lambda: PF2MPConfig(**U_NET),
    "diffusion": lambda: DiffusionConfig(**DENOISING),
    "dppf": lambda: DPPFConfig(**DENOISING),
    "act": lambda: ACTConfig(**TRANSFORMER),
    "guarded": lambda: GuardedConfig(base=ACTConfig(**TRANSFORMER)),
}


def write_checkpoint(folder: Path, kind: str, seed: int = 0) -> str:
    """An untrained policy: its weights are those of its seed, its field covers the middle of the maze."""
    torch.manual_seed(seed)
    config = MAKE_CONFIG[kind]()
    ends = {
        "min": torch.full((2,), -HALF_WIDTH),
        "max": torch.full((2,), HALF_WIDTH),
        "mean": torch.zeros(2),
        "std": torch.ones(2),
    }
    policy = get_policy_class(kind)(config)
    preprocessor, postprocessor = make_pre_post_processors(
        config, dataset_stats=dict.fromkeys((STATE, ENV, ACTION), ends)
    )
    for step in preprocessor.steps:
        if isinstance(step, PotentialFieldProcessorStep):
            step.demonstrations.observe(
                0.3 * torch.randn(4, 8, 2),
                None,
                8 * torch.arange(4),
                torch.arange(4),  # one chunk of each episode
                settings=config.field_settings,
                n_executed=config.n_action_steps,
            )
    for part in (policy, preprocessor, postprocessor):
        part.save_pretrained(folder)
    return str(folder)
