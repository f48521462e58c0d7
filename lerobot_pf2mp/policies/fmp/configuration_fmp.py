# SPDX-License-Identifier: Apache-2.0
"""Configuration of the Flow Matching Policy."""

import math
from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig
from lerobot.policies.rtc.configuration_rtc import RTCConfig

from lerobot_pf2mp.errors import reported_on_the_command_line
from lerobot_pf2mp.flow_matching import INTEGRATORS, TIME_SAMPLINGS
from lerobot_pf2mp.policies.fmp.fused_adamw import FusedAdamWConfig
from lerobot_pf2mp.policies.option_kinds import check_kinds_and_sizes


@PreTrainedConfig.register_subclass("fmp")
@dataclass
class FMPConfig(PreTrainedConfig):
    """Configuration of the Flow Matching Policy (FMP, Section IV-A of the paper).

    At least one of "observation.state", "observation.environment_state" and "observation.images.*" must be among the
    inputs, and "action" is the output. Actions should be positions rather than displacements: see `PF2MPConfig`.

    Args:
        n_obs_steps: Number of observations that the policy gets, including the current one.
        horizon: Actions predicted at once (T_a in the paper), counted from the oldest observation. A multiple of
            2^(len(down_dims) - 1), the U-Net's downsampling.
        n_action_steps: Predicted actions executed before the next prediction; at most horizon - n_obs_steps + 1.
        drop_n_last_frames: Frames at the end of every episode that do not start a training chunk. horizon - 1 trains
            on complete chunks only, which is the paper's setting for episodes resampled to `horizon` steps.
        normalization_mapping: How each kind of feature is normalised.
        vision_backbone: A torchvision ResNet.
        resize_shape: (H, W) to which images are resized [pixels]; None does not resize.
        crop_ratio: Crop size as a fraction of `resize_shape`; 1 does not crop.
        crop_shape: (H, W) of the crop [pixels]; follows from `resize_shape` and `crop_ratio` if those are given.
        crop_is_random: Whether training crops at random positions; evaluation always crops the centre.
        pretrained_backbone_weights: Torchvision weights to start from; None starts at random.
        use_group_norm: Whether group norm replaces batch norm in the backbone.
        spatial_softmax_num_keypoints: Keypoints for each image.
        use_separate_rgb_encoder_per_camera: Whether every camera has its own encoder.
        down_dims: Channels of the U-Net's levels. The paper uses (512, 256, 128).
        kernel_size: Width of the U-Net's convolutions.
        n_groups: Groups of the U-Net's group norm; divides every entry of `down_dims`.
        diffusion_step_embed_dim: Size of the embedding of t (LeRobot's name).
        use_film_scale_modulation: Whether the condition scales as well as shifts the U-Net's features.
        gradient_checkpointing: Whether training recomputes the U-Net's blocks to save memory.
        num_inference_steps: Integration steps N.
        integrator: How the flow is integrated: euler (the paper) or midpoint (two network calls a step).
        rtc_config: Options of real-time chunking, which lerobot-rollout --inference.type=rtc sets; None is off.
        compile_model: Whether to torch.compile the U-Net.
        compile_mode: Mode for torch.compile.
        time_sampling: Training times: uniform (the paper) or beta (more weight on the noisy end).
        do_mask_loss_for_padding: Whether the loss leaves out actions beyond the end of their episode.
        use_ema: Whether evaluation and checkpoints use an exponential moving average of the weights.
        ema_decay: Decay of that average for each step. Early steps n use (1 + n) / (10 + n), so that the average soon
            forgets the initial weights.
        optimizer_lr: Learning rate of AdamW at the end of the warm-up.
        optimizer_betas: Betas of AdamW.
        optimizer_eps: Epsilon of AdamW.
        optimizer_weight_decay: Weight decay of AdamW.
        optimizer_grad_clip_norm: Largest norm of the gradient.
        scheduler_warmup_steps: Steps of linear warm-up, after which a cosine takes the learning rate to zero.
    """

    # Inputs and outputs.
    n_obs_steps: int = 1
    horizon: int = 64
    n_action_steps: int = 32
    drop_n_last_frames: int = 0
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.MEAN_STD,
            "STATE": NormalizationMode.MIN_MAX,
            "ENV": NormalizationMode.MIN_MAX,
            "ACTION": NormalizationMode.MIN_MAX,
        }
    )

    # Vision.
    vision_backbone: str = "resnet18"
    resize_shape: tuple[int, int] | None = None
    crop_ratio: float = 1.0
    crop_shape: tuple[int, int] | None = None
    crop_is_random: bool = True
    pretrained_backbone_weights: str | None = None
    use_group_norm: bool = True
    spatial_softmax_num_keypoints: int = 32
    use_separate_rgb_encoder_per_camera: bool = False

    # U-Net.
    down_dims: tuple[int, ...] = (512, 256, 128)
    kernel_size: int = 5
    n_groups: int = 8
    diffusion_step_embed_dim: int = 128
    use_film_scale_modulation: bool = True
    gradient_checkpointing: bool = False

    # Inference.
    num_inference_steps: int = 5
    integrator: str = "euler"
    rtc_config: RTCConfig | None = None
    compile_model: bool = False
    compile_mode: str = "default"

    # Training.
    time_sampling: str = "uniform"
    do_mask_loss_for_padding: bool = True
    use_ema: bool = True
    ema_decay: float = 0.999
    optimizer_lr: float = 1e-3
    optimizer_betas: tuple[float, float] = (0.9, 0.999)
    optimizer_eps: float = 1e-8
    optimizer_weight_decay: float = 1e-6
    optimizer_grad_clip_norm: float = 1.0
    scheduler_warmup_steps: int = 200

    def __post_init__(self) -> None:
        """Validates the values.

        Raises:
            ConfigError: If one breaks its rule.
        """
        super().__post_init__()
        with reported_on_the_command_line():
            self._validate()

    def _validate(self) -> None:
        check_kinds_and_sizes(self)
        for name in ("n_obs_steps", "horizon", "n_action_steps", "num_inference_steps", "n_groups"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        most_actions = self.horizon - self.n_obs_steps + 1
        if self.n_action_steps > most_actions:
            raise ValueError(
                f"n_action_steps must be at most horizon - n_obs_steps + 1 = {most_actions}, got "
                f"n_action_steps={self.n_action_steps}, horizon={self.horizon}, n_obs_steps={self.n_obs_steps}"
            )
        if self.drop_n_last_frames < 0:
            raise ValueError(f"drop_n_last_frames must be at least 0, got {self.drop_n_last_frames}")
        if not self.down_dims or any(width < 1 or width % self.n_groups for width in self.down_dims):
            raise ValueError(
                f"every entry of down_dims must be a positive multiple of n_groups={self.n_groups}, got {self.down_dims}"
            )
        factor = 2 ** (len(self.down_dims) - 1)
        if self.horizon % factor:
            raise ValueError(
                f"horizon must be a multiple of {factor}, the downsampling of a U-Net with {len(self.down_dims)} levels, "
                f"got horizon={self.horizon} and down_dims={self.down_dims}"
            )
        if self.kernel_size < 1 or self.kernel_size % 2 == 0:
            raise ValueError(f"kernel_size must be odd, so that lengths are kept, got {self.kernel_size}")
        if self.diffusion_step_embed_dim < 4 or self.diffusion_step_embed_dim % 2:
            raise ValueError(
                f"diffusion_step_embed_dim must be even and at least 4, got {self.diffusion_step_embed_dim}"
            )
        if self.integrator not in INTEGRATORS:
            raise ValueError(f"integrator must be one of {INTEGRATORS}, got {self.integrator!r}")
        if self.time_sampling not in TIME_SAMPLINGS:
            raise ValueError(f"time_sampling must be one of {TIME_SAMPLINGS}, got {self.time_sampling!r}")
        if not 0 <= self.ema_decay < 1:
            raise ValueError(f"ema_decay must lie in [0, 1), got {self.ema_decay}")
        if not (math.isfinite(self.optimizer_lr) and self.optimizer_lr > 0):
            raise ValueError(f"optimizer_lr must be finite and positive, got {self.optimizer_lr}")
        self._validate_vision()

    def _validate_vision(self) -> None:
        if not self.vision_backbone.startswith("resnet"):
            raise ValueError(f"vision_backbone must be a torchvision ResNet, got {self.vision_backbone!r}")
        if self.pretrained_backbone_weights and self.use_group_norm:
            raise ValueError(
                "use_group_norm must be false with pretrained_backbone_weights: replacing the batch norm would ruin "
                f"them, got {self.pretrained_backbone_weights!r}"
            )
        if not 0 < self.crop_ratio <= 1:
            raise ValueError(f"crop_ratio must lie in (0, 1], got {self.crop_ratio}")
        for name in ("resize_shape", "crop_shape"):
            shape = getattr(self, name)
            if shape is not None and (len(shape) != 2 or min(shape) < 1):
                raise ValueError(f"{name} must be two positive numbers of pixels, got {shape}")
        if self.resize_shape is not None and self.crop_ratio < 1:
            height, width = self.resize_shape
            self.crop_shape = (int(height * self.crop_ratio), int(width * self.crop_ratio))

    def validate_features(self) -> None:
        """Checks the input and output features. They are not known before a dataset or an environment is.

        Raises:
            ValueError: If there is no observation or no action, or the images do not fit.
        """
        if self.action_feature is None:
            raise ValueError(f"output_features must hold 'action', got {list(self.output_features or {})}")
        images = self.image_features
        if self.robot_state_feature is None and self.env_state_feature is None and not images:
            raise ValueError(
                "input_features must hold observation.state, observation.environment_state or a camera, got "
                f"{list(self.input_features or {})}"
            )
        if len({feature.shape for feature in images.values()}) > 1:
            raise ValueError(f"all cameras must have one image shape, got {images}")
        crop = self.crop_shape
        if images and crop is not None:
            _, height, width = next(iter(images.values())).shape
            limit = self.resize_shape or (height, width)
            if crop[0] > limit[0] or crop[1] > limit[1]:
                raise ValueError(f"crop_shape must fit into the images of {limit} pixels, got {crop}")

    def get_optimizer_preset(self) -> FusedAdamWConfig:
        """AdamW with this configuration's values."""
        return FusedAdamWConfig(
            lr=self.optimizer_lr,
            betas=self.optimizer_betas,
            eps=self.optimizer_eps,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.optimizer_grad_clip_norm,
        )

    def get_scheduler_preset(self) -> CosineAnnealingWithWarmupSchedulerConfig:
        """Linear warm-up, then a cosine to zero over the training run."""
        return CosineAnnealingWithWarmupSchedulerConfig(num_warmup_steps=self.scheduler_warmup_steps)

    @property
    def observation_delta_indices(self) -> list[int] | None:
        """Offsets of the observed frames [steps]; None for the current frame alone.

        With None the loader reads no observation window, which saves a third of its time. Observations then have the shape
        ``(B, D)``.
        """
        return None if self.n_obs_steps == 1 else list(range(1 - self.n_obs_steps, 1))

    @property
    def action_delta_indices(self) -> list[int]:
        """Offsets of the predicted actions [steps]."""
        return list(range(1 - self.n_obs_steps, 1 - self.n_obs_steps + self.horizon))

    @property
    def reward_delta_indices(self) -> None:
        """Rewards are not used."""
        return None
