# SPDX-License-Identifier: Apache-2.0
"""The Flow Matching Policy (Section IV-A of the paper) behind LeRobot's policy interface."""

from collections import deque
from collections.abc import Iterable
from typing import Any, Protocol, cast

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.policies.rtc.modeling_rtc import RTCProcessor
from lerobot.policies.utils import populate_queues
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE
from torch import Tensor

from lerobot_pf2mp.flow_matching import Guide, flow_matching_loss, integrate, sample_time
from lerobot_pf2mp.policies.batch_keys import ACTION_IS_PAD
from lerobot_pf2mp.policies.checked_loading import require_own_config
from lerobot_pf2mp.policies.fmp.configuration_fmp import FMPConfig
from lerobot_pf2mp.policies.fmp.ema import MovingAverage
from lerobot_pf2mp.policies.fmp.networks import VelocityNetwork
from lerobot_pf2mp.policies.fmp.real_time_chunking import continuing
from lerobot_pf2mp.policies.guided.integrated_actions import guide_for_rows
from lerobot_pf2mp.policies.image_sizes import check_image_sizes
from lerobot_pf2mp.policies.own_policy import OwnPolicy
from lerobot_pf2mp.policies.plans.plans import require_finite


class Draw(Protocol):
    """Draws chunks."""

    def __call__(
        self,
        noise: Tensor | None = None,
        generator: torch.Generator | None = None,
        rows: Tensor | None = None,
        n_each: int = 1,
    ) -> Tensor:
        """Chunks ``(B, n_action_steps, A)`` [normalised].

        Args:
            noise: ``(B, horizon, A)`` prior samples; drawn from N(0, I) if None.
            generator: Source of randomness for that draw.
            rows: ``(F,)`` robots of the batch, for B = F n_each chunks, those of a robot one after the other; None for one
                chunk of each robot.
            n_each: Number of chunks for each of these robots.
        """


class FMPPolicy(OwnPolicy, PreTrainedPolicy):
    """Generates chunks of actions by integrating a learned velocity field from noise.

    Of a chunk of `horizon` actions, counted from the oldest of `n_obs_steps` observations, the `n_action_steps` from
    the current step on are executed before the next prediction:

        step          n-o+1 ... n-1 |  n  ... n+a-1 | n+a ... n-o+h        o = n_obs_steps, a = n_action_steps,
        observed       yes  ... yes | yes      no   |  no ...  no          h = horizon
        generated      yes  ... yes | yes ...  yes  | yes ... yes
        executed       no   ...  no | yes ...  yes  |  no ...  no

    Args:
        config: The policy's configuration.
        dataset_stats: Statistics of the training dataset; None at evaluation.
        dataset_meta: Its metadata (not used).
    """

    config_class = FMPConfig
    name = "fmp"
    config: FMPConfig

    def __init__(
        self,
        config: FMPConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: Any = None,
        **kwargs: Any,
    ) -> None:
        require_own_config(self, config)
        super().__init__(config)
        config.validate_features()
        self.network = VelocityNetwork(config)
        self.ema = MovingAverage(self.network, config.ema_decay) if config.use_ema else None
        self.register_load_state_dict_pre_hook(_start_missing_average_at_the_weights)
        if config.compile_model:
            for network in (self.network, self.inference_network):
                network.unet.compile(mode=config.compile_mode)
        self.init_rtc_processor()
        self.reset()

    @property
    def inference_network(self) -> VelocityNetwork:
        """The network that evaluation uses: the moving average, unless `use_ema` is off."""
        return self.network if self.ema is None else cast(VelocityNetwork, self.ema.module)

    def get_optim_params(self) -> Iterable[torch.nn.Parameter]:
        """The weights that the optimiser trains."""
        return self.network.parameters()

    def update(self) -> None:
        """Updates the moving average of the weights. LeRobot calls this after every optimiser step."""
        if self.ema is not None:
            self.ema.update_parameters(self.network)

    def reset(self) -> None:
        """Forgets past observations and planned actions. Must be called at the start of an episode."""
        self._queues: dict[str, deque[Tensor]] = {ACTION: deque(maxlen=self.config.n_action_steps)}
        for key in self._observation_keys:
            self._queues[key] = deque(maxlen=self.config.n_obs_steps)

    def supports_rtc(self) -> bool:
        """Whether real-time chunking works: only with one observation, because the chunk then begins at the current step."""
        return self.config.n_obs_steps == 1

    def init_rtc_processor(self) -> None:
        """Creates LeRobot's RTC processor from `rtc_config`. LeRobot calls this after it has set that option."""
        rtc_config = self.config.rtc_config
        is_on = rtc_config is not None and rtc_config.enabled
        self.rtc_processor = RTCProcessor(rtc_config) if is_on else None

    def forward(self, batch: dict[str, Any], reduction: str = "mean") -> tuple[Tensor, None]:
        """The flow matching loss of a batch (Algorithm 1). In evaluation mode it uses the moving average of the weights.

        Args:
            batch: ``{"observation.state": (B, [n_obs_steps,] state_dim), "observation.environment_state": (B,
                [n_obs_steps,] env_dim), "observation.images.*": (B, [n_obs_steps,] C, H, W), "action": (B, horizon,
                action_dim), "action_is_pad": (B, horizon)}``, normalised; observations as configured.
            reduction: ``mean`` over all valid actions, or ``none`` for the mean of each sample, ``(B,)``.

        Returns:
            The loss, and None.

        Raises:
            ValueError: If the reduction is unknown, the chunk has another length than `horizon`, or the loss is not
                finite because the batch is not.
        """
        if reduction not in ("mean", "none"):
            raise ValueError(f"reduction must be 'mean' or 'none', got {reduction!r}")
        x_1 = batch[ACTION]  # (B, T, A)
        if x_1.ndim != 3 or x_1.shape[1] != self.config.horizon:
            raise ValueError(
                f"action must have shape (B, horizon={self.config.horizon}, A), got {tuple(x_1.shape)}"
            )
        network = self.network if self.training else self.inference_network
        condition = network.encoder(self._observation_window(batch))
        is_pad = batch.get(ACTION_IS_PAD) if self.config.do_mask_loss_for_padding else None
        loss = flow_matching_loss(
            lambda x_t, t: network(x_t, t, condition),
            x_0=torch.randn_like(x_1),
            x_1=x_1,
            t=sample_time(len(x_1), self.config.time_sampling, device=x_1.device),
            is_pad=is_pad,
        )  # (B, T)
        n_valid = torch.full_like(loss[:, 0], loss.shape[1]) if is_pad is None else (~is_pad).sum(dim=1)
        if reduction == "none":
            return loss.sum(dim=1) / n_valid.clamp_min(1), None
        loss = loss.sum() / n_valid.sum().clamp_min(1)
        if not torch.isfinite(loss):
            _raise_for_non_finite(batch)
        return loss, None

    @torch.no_grad()
    def predict_action_chunk(
        self,
        batch: dict[str, Any],
        noise: Tensor | None = None,
        generator: torch.Generator | None = None,
        guide: Guide | None = None,
        *,
        inference_delay: int = 0,
        prev_chunk_left_over: Tensor | None = None,
        execution_horizon: int | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """The next `n_action_steps` actions, ``(B, n_action_steps, action_dim)`` [normalised].

        With real-time chunking it returns all ``horizon`` actions, and the first of them continue the last chunk.

        Args:
            batch: Normalised observations as for `forward`. A single frame is repeated for the whole window if
                `n_obs_steps` > 1.
            noise: ``(B, horizon, action_dim)`` prior sample x_0; drawn from N(0, I) if None.
            generator: Source of randomness for that draw.
            guide: Changes every integration step; None leaves the flow unchanged.
            inference_delay: Real-time chunking: steps that are executed before this chunk is available.
            prev_chunk_left_over: Real-time chunking: ``([B,] T_left, action_dim)`` the last chunk's actions that have not
                been executed [normalised]; None if this chunk continues no other.
            execution_horizon: Real-time chunking: number of steps over which this chunk is pulled towards those actions;
                None for the value of the configuration.
            **kwargs: Ignored, for callers that pass options of other policies.

        Raises:
            ValueError: If the noise has another shape, there is a last chunk but real-time chunking is off, or an action is
                not finite.
        """
        draw = self._drawing(
            batch,
            guide,
            inference_delay=inference_delay,
            prev_chunk_left_over=prev_chunk_left_over,
            execution_horizon=execution_horizon,
        )
        return require_finite(draw(noise, generator), batch)

    def _drawing(
        self,
        batch: dict[str, Any],
        guide: Guide | None,
        *,
        inference_delay: int = 0,
        prev_chunk_left_over: Tensor | None = None,
        execution_horizon: int | None = None,
        **_: Any,
    ) -> Draw:
        """A function that draws chunks for a batch. The observations are encoded once. Arguments as above."""
        if prev_chunk_left_over is not None and self.rtc_processor is None:
            raise ValueError(
                "prev_chunk_left_over needs rtc_config, got none: call init_rtc_processor() after setting it"
            )
        network = self.inference_network
        encoded = network.encoder(self._observation_window(batch))
        start = self.config.n_obs_steps - 1
        end = None if self.rtc_processor is not None else start + self.config.n_action_steps

        def draw(
            noise: Tensor | None = None,
            generator: torch.Generator | None = None,
            rows: Tensor | None = None,
            n_each: int = 1,
        ) -> Tensor:
            condition, left_over = encoded, prev_chunk_left_over
            if rows is not None:
                condition = encoded[rows].repeat_interleave(n_each, dim=0)
                if left_over is not None and left_over.ndim == 3 and len(left_over) == len(encoded):
                    left_over = left_over[rows].repeat_interleave(n_each, dim=0)
            shape = (condition.shape[0], self.config.horizon, self.config.action_feature.shape[0])
            if noise is None:
                noise = torch.randn(shape, device=condition.device, generator=generator)
            elif tuple(noise.shape) != shape:
                raise ValueError(f"noise must have shape {shape}, got {tuple(noise.shape)}")
            steer = None
            if self.rtc_processor is not None and left_over is not None:
                steer = continuing(self.rtc_processor, left_over, inference_delay, execution_horizon)
            chunk = integrate(
                lambda x_t, t: network(x_t, t, condition),
                noise.to(device=condition.device, dtype=torch.float32),
                self.config.num_inference_steps,
                integrator=self.config.integrator,
                guide=guide if rows is None else guide_for_rows(guide, rows, n_each),
                steer=steer,
            )  # (B, T, A)
            return chunk[:, start:end]

        return draw

    @torch.no_grad()
    def select_action(
        self,
        batch: dict[str, Any],
        noise: Tensor | None = None,
        generator: torch.Generator | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """The action for the current step, ``(B, action_dim)`` [normalised].

        Args:
            batch: Normalised observations of the current step, ``(B, ...)``.
            noise: Prior sample for the next prediction, as for `predict_action_chunk`.
            generator: Source of randomness for the next prediction.
            **kwargs: Ignored, as in `predict_action_chunk`.

        Raises:
            RuntimeError: If real-time chunking is on, because it needs whole chunks.
        """
        if self.rtc_processor is not None:
            raise RuntimeError("with real-time chunking use predict_action_chunk instead of select_action")
        observation = {key: value for key, value in batch.items() if key != ACTION}
        if self.config.image_features:
            observation[OBS_IMAGES] = self._stack_cameras(batch)
        populate_queues(self._queues, observation)
        if not self._queues[ACTION]:
            window = {key: torch.stack(list(self._queues[key]), dim=1) for key in self._observation_keys}
            chunk = self.predict_action_chunk({**batch, **window}, noise=noise, generator=generator)
            self._queues[ACTION].extend(chunk.unbind(dim=1))
        return self._queues[ACTION].popleft()

    @property
    def _observation_keys(self) -> list[str]:
        present = {
            OBS_STATE: self.config.robot_state_feature is not None,
            OBS_ENV_STATE: self.config.env_state_feature is not None,
            OBS_IMAGES: bool(self.config.image_features),
        }
        return [key for key, is_present in present.items() if is_present]

    def _observation_window(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """The observations as ``(B, n_obs_steps, ...)``. The images of all cameras are stacked into one tensor."""
        window = {}
        for key in self._observation_keys:
            value = batch.get(key)
            if value is None and key == OBS_IMAGES:
                value = self._stack_cameras(batch)
            if value is None:
                raise ValueError(f"the policy observes {self._observation_keys}, got a batch without {key!r}")
            n_dims = 6 if key == OBS_IMAGES else 3
            if value.ndim == n_dims - 1:
                value = value.unsqueeze(1).expand(-1, self.config.n_obs_steps, *value.shape[1:])
            if value.ndim != n_dims or value.shape[1] != self.config.n_obs_steps:
                raise ValueError(
                    f"{key} must hold n_obs_steps={self.config.n_obs_steps} frames, got {tuple(value.shape)}"
                )
            window[key] = value
        return window

    def _stack_cameras(self, batch: dict[str, Any]) -> Tensor:
        """The cameras' images as ``(B, [n_obs_steps,] n_cameras, C, H, W)``.

        Raises:
            ValueError: If they are of another size than the policy was made for.
        """
        check_image_sizes(self.config, batch)
        return torch.stack([batch[key] for key in self.config.image_features], dim=-4)


def _start_missing_average_at_the_weights(
    policy: FMPPolicy, state_dict: dict[str, Tensor], prefix: str, *_: Any
) -> None:
    """Sets the average to the weights if a checkpoint holds no average. Otherwise it would keep its random start."""
    average_prefix = f"{prefix}ema."
    if policy.ema is None or any(key.startswith(average_prefix) for key in state_dict):
        return
    for key in [key for key in state_dict if key.startswith(f"{prefix}network.")]:
        state_dict[f"{average_prefix}module.{key.removeprefix(f'{prefix}network.')}"] = state_dict[key]
    state_dict[f"{average_prefix}n_averaged"] = torch.zeros_like(policy.ema.n_averaged)


def _raise_for_non_finite(batch: dict[str, Any]) -> None:
    bad = [
        key
        for key, value in batch.items()
        if isinstance(value, Tensor) and value.is_floating_point() and not torch.isfinite(value).all()
    ]
    if bad:
        raise ValueError(f"the dataset must be finite, got NaN or infinite values in {', '.join(bad)}")
    raise ValueError("the loss is not finite although the batch is: lower the learning rate")
