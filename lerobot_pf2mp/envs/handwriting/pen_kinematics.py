# SPDX-License-Identifier: Apache-2.0
"""Inverse and forward kinematics of the Panda's pen. The solver is mink's."""

from __future__ import annotations

import mink
import mujoco
import numpy as np

from lerobot_pf2mp.envs.handwriting.panda import HOME, PEN_TIP

# Rotation of the upright pen: its axis points down.
_UPRIGHT = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_MAX_ITERATIONS = 100
_CONVERGED = 1e-6  # last change of a joint [rad]
_LARGEST_ERROR = 1e-4  # [m] and [rad]


class PenKinematics:
    """Turns positions of the upright pen into joint positions, and joint positions into positions of the pen.

    The arm has one joint more than needed. The solution is the posture nearest to `panda.HOME`. So it is a function of the
    pen's position only, and it is smooth.

    Args:
        model: A model from `make_panda`.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._configuration = mink.Configuration(model)
        self._pen = mink.FrameTask(PEN_TIP, "site", position_cost=1.0, orientation_cost=0.2)
        self._posture = mink.PostureTask(model, cost=1e-3)
        self._posture.set_target(HOME)
        self._limits = [mink.ConfigurationLimit(model)]

    def joints(self, position: np.ndarray, height: float = 0.0) -> np.ndarray:
        """Joint positions ``(9,)`` with the pen upright at a position [rad], fingers [m].

        Args:
            position: ``(2,)`` x, y of the pen's tip [m].
            height: z of the pen's tip [m].

        Raises:
            ValueError: If the arm does not reach this position.
        """
        target = mink.SO3.from_matrix(_UPRIGHT), np.array([*position, height])
        self._pen.set_target(mink.SE3.from_rotation_and_translation(*target))
        self._configuration.update(HOME)  # from another start the search may fail
        for _ in range(_MAX_ITERATIONS):
            velocity = mink.solve_ik(
                self._configuration, [self._pen, self._posture], 1.0, "daqp", limits=self._limits
            )
            self._configuration.integrate_inplace(velocity, 1.0)
            if np.abs(velocity).max() < _CONVERGED:
                break
        if np.abs(self._pen.compute_error(self._configuration)).max() > _LARGEST_ERROR:
            raise ValueError(
                f"the arm must reach the pen's position x, y [m], got {np.asarray(position).tolist()}"
            )
        return self._configuration.q.copy()

    def joint_trajectory(self, positions: np.ndarray) -> np.ndarray:
        """Joint positions ``(N, 9)`` for ``(N, 2)`` positions of the pen, one after the other.

        Raises:
            ValueError: If the arm does not reach one of them.
        """
        return np.array([self.joints(position) for position in positions])

    def tips(self, joints: np.ndarray) -> np.ndarray:
        """Positions ``(N, 3)`` of the pen's tip for ``(N, 9)`` joint positions [m]."""
        tips = []
        for each in joints:
            self._configuration.update(each)
            tips.append(self._configuration.data.site(PEN_TIP).xpos.copy())
        return np.array(tips)
