# SPDX-License-Identifier: Apache-2.0
"""The progress bar of an expert's training."""

from __future__ import annotations

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from tqdm import tqdm


class ExpertProgress(BaseCallback):
    """Advances a progress bar and shows the success rate of the last 100 episodes (with exploration).

    Args:
        bar: The bar, in environment steps.
    """

    def __init__(self, bar: tqdm) -> None:
        super().__init__()
        self._bar = bar

    def _on_step(self) -> bool:
        self._bar.update(self.training_env.num_envs)
        return True

    def _on_rollout_start(self) -> None:
        successes = self.model.ep_success_buffer
        if successes:
            self._bar.set_postfix(success=f"{np.mean(successes):.0%}", refresh=False)
