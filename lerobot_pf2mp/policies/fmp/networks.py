# SPDX-License-Identifier: Apache-2.0
"""The velocity network v_theta(x_t, t; o): an observation encoder and a 1-D U-Net, from LeRobot's diffusion modules."""

from __future__ import annotations

from typing import TYPE_CHECKING

import einops
import torch
from lerobot.policies.diffusion.modeling_diffusion import DiffusionConditionalUnet1d, DiffusionRgbEncoder
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES, OBS_STATE
from torch import Tensor, nn

if TYPE_CHECKING:
    from lerobot_pf2mp.policies.fmp.configuration_fmp import FMPConfig

# LeRobot's sinusoidal embedding is made for diffusion steps 0..100. Flow times 0..1 are scaled to the same range.
_TIME_SCALE = 100.0


class ObservationEncoder(nn.Module):
    """Turns a window of observations into one conditioning vector.

    States stay unchanged. Images are encoded by LeRobot's ResNet with spatial softmax. The results are concatenated over
    keys, cameras and time.

    Args:
        config: The policy's configuration. Its `input_features` are encoded.
    """

    def __init__(self, config: FMPConfig) -> None:
        super().__init__()
        self.has_state = config.robot_state_feature is not None
        self.has_env_state = config.env_state_feature is not None
        self.n_cameras = len(config.image_features)
        dim = 0
        if config.robot_state_feature is not None:
            dim += config.robot_state_feature.shape[0]
        if config.env_state_feature is not None:
            dim += config.env_state_feature.shape[0]
        if self.n_cameras:
            n_encoders = self.n_cameras if config.use_separate_rgb_encoder_per_camera else 1
            encoders = [DiffusionRgbEncoder(config) for _ in range(n_encoders)]
            self.rgb_encoders = nn.ModuleList(encoders)
            dim += self.n_cameras * encoders[0].feature_dim
        self.output_dim = dim * config.n_obs_steps

    def forward(self, batch: dict[str, Tensor]) -> Tensor:
        """The conditioning vector ``(B, output_dim)``.

        Args:
            batch: ``{"observation.state": (B, n_obs_steps, state_dim), "observation.environment_state":
                (B, n_obs_steps, env_dim), "observation.images": (B, n_obs_steps, n_cameras, C, H, W)}``, normalised.
                Only the keys of the configuration's features are needed.
        """
        features = []
        if self.has_state:
            features.append(batch[OBS_STATE])
        if self.has_env_state:
            features.append(batch[OBS_ENV_STATE])
        if self.n_cameras:
            features.append(self._encode_images(batch[OBS_IMAGES]))
        return torch.cat(features, dim=-1).flatten(start_dim=1)

    def _encode_images(self, images: Tensor) -> Tensor:
        n_steps = images.shape[1]
        if len(self.rgb_encoders) == 1:
            encoded = self.rgb_encoders[0](einops.rearrange(images, "b s n c h w -> (b s n) c h w"))
            return einops.rearrange(encoded, "(b s n) f -> b s (n f)", s=n_steps, n=self.n_cameras)
        encoded = torch.stack(
            [
                encoder(einops.rearrange(camera, "b s c h w -> (b s) c h w"))
                for encoder, camera in zip(self.rgb_encoders, images.unbind(dim=2), strict=True)
            ]
        )
        return einops.rearrange(encoded, "n (b s) f -> b s (n f)", s=n_steps)


class VelocityNetwork(nn.Module):
    """The velocity v_theta(x_t, t; o) of a chunk of actions, given encoded observations.

    Args:
        config: The policy's configuration.
    """

    def __init__(self, config: FMPConfig) -> None:
        super().__init__()
        self.encoder = ObservationEncoder(config)
        self.unet = DiffusionConditionalUnet1d(config, global_cond_dim=self.encoder.output_dim)

    def forward(self, x_t: Tensor, t: Tensor, condition: Tensor) -> Tensor:
        """The velocity, ``(B, horizon, action_dim)``, float32 also under autocast.

        Args:
            x_t: ``(B, horizon, action_dim)`` chunks between noise and data, x_t [normalised].
            t: ``(B,)`` times in [0, 1].
            condition: ``(B, encoder.output_dim)`` encoded observations.
        """
        return self.unet(x_t, _TIME_SCALE * t, global_cond=condition).float()
