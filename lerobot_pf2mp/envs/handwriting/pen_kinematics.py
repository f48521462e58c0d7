# SPDX-License-Identifier: Apache-2.0
"""Inverse and forward kinematics of an arm's pen. The solver is mink's."""

from __future__ import annotations

import mink
import mujoco
import numpy as np

from lerobot_pf2mp.envs.handwriting.arm import Arm
from lerobot_pf2mp.envs.handwriting.pen import PEN_TIP

_MAX_ITERATIONS = 100
_CONVERGED = 1e-6  # last change of a joint [rad]
_LARGEST_ERROR = 1e-4  # [m] and [rad]
# Out of reach the pen stays upright and at its height, and comes as near as it can.
_SIDEWAYS, _UPRIGHT_AND_AT_HEIGHT = 1.0, 30.0
_DAMPING = 1.0  # of these searches, relative to the squared error; with less they swing to and fro
_STARTS = 5  # angles of the first joint from which they start


class PenKinematics:
    """Turns positions of the upright pen into joint positions, and joint positions into positions of the pen.

    The arm has one joint more than needed. The solution is the posture nearest to its home. So it is a function of the pen's
    position only, and it is smooth.

    Args:
        arm: The arm.
        model: A model with it from `make_writing_model`.
    """

    def __init__(self, arm: Arm, model: mujoco.MjModel) -> None:
        self._model, self._home, self._upright = model, arm.home, mink.SO3.from_matrix(arm.upright)
        self._configuration = mink.Configuration(model)
        self._is_turned = np.array(arm.turning_cost) > 0
        self._pen = mink.FrameTask(PEN_TIP, "site", position_cost=1.0, orientation_cost=arm.turning_cost)
        self._pen_nearby = mink.FrameTask(
            PEN_TIP,
            "site",
            position_cost=(_SIDEWAYS, _SIDEWAYS, _UPRIGHT_AND_AT_HEIGHT),
            orientation_cost=_UPRIGHT_AND_AT_HEIGHT * self._is_turned,
            lm_damping=_DAMPING,
        )
        self._posture = mink.PostureTask(model, cost=1e-3)
        self._posture.set_target(arm.home)
        self._limits = [mink.ConfigurationLimit(model)]

    def joints(self, position: np.ndarray, height: float = 0.0) -> np.ndarray:
        """Joint positions ``(J,)`` with the pen upright at a position [rad], fingers [m].

        Args:
            position: ``(2,)`` x, y of the pen's tip [m].
            height: z of the pen's tip [m].

        Raises:
            ValueError: If the arm does not reach this position.
        """
        if not self._reaches(position, height):
            raise ValueError(
                f"the arm must reach the pen's position x, y [m], got {np.asarray(position).tolist()}"
            )
        return self._configuration.q.copy()

    def nearest_joints(self, position: np.ndarray, height: float = 0.0) -> tuple[np.ndarray, float]:
        """Joint positions ``(J,)`` with the pen upright at a position, or as near to it as the joints allow [rad; m].

        Args:
            position: ``(2,)`` x, y of the pen's tip [m].
            height: z of the pen's tip [m].

        Returns:
            The joint positions, and the distance of the pen to the position that was asked for [m], 0 if it is reached.
        """
        if self._reaches(position, height):
            return self._configuration.q.copy(), 0.0
        low, high = self._model.jnt_range.T
        found = []
        for first in np.linspace(
            low[0], high[0], _STARTS
        ):  # a search may end at a limit, in front of a nearer position
            self._search(self._pen_nearby, position, height, start=np.array([first, *self._home[1:]]))
            found.append(self._configuration.q.clip(low, high))
        missed = np.linalg.norm(self.tips(np.array(found)) - [*position, height], axis=1)
        return found[int(missed.argmin())], float(missed.min())

    def _reaches(self, position: np.ndarray, height: float) -> bool:
        """Searches joint positions, and says whether they were found."""
        self._search(self._pen, position, height)
        error = np.abs(self._pen.compute_error(self._configuration))
        error[3:] *= self._is_turned
        return bool(error.max() <= _LARGEST_ERROR)

    def _search(
        self, pen: mink.FrameTask, position: np.ndarray, height: float, start: np.ndarray | None = None
    ) -> None:
        self._configuration.update(self._home if start is None else start)  # from another start it may fail
        for _ in range(_MAX_ITERATIONS):
            target = self._upright_pen(), np.array([*position, height])
            pen.set_target(mink.SE3.from_rotation_and_translation(*target))
            velocity = mink.solve_ik(
                self._configuration, [pen, self._posture], 1.0, "daqp", limits=self._limits
            )
            self._configuration.integrate_inplace(velocity, 1.0)
            if np.abs(velocity).max() < _CONVERGED:
                break

    def _upright_pen(self) -> mink.SO3:
        """The rotation of an upright pen; turned about itself as the pen is now, if that costs nothing."""
        if self._is_turned[2]:
            return self._upright
        pen = self._configuration.get_transform_frame_to_world(PEN_TIP, "site").rotation()
        R = (pen @ self._upright.inverse()).as_matrix()
        return mink.SO3.from_z_radians(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])) @ self._upright

    def joint_trajectory(self, positions: np.ndarray) -> np.ndarray:
        """Joint positions ``(N, J)`` for ``(N, 2)`` positions of the pen, one after the other.

        Raises:
            ValueError: If the arm does not reach one of them.
        """
        return np.array([self.joints(position) for position in positions])

    def tips(self, joints: np.ndarray) -> np.ndarray:
        """Positions ``(N, 3)`` of the pen's tip for ``(N, J)`` joint positions [m]."""
        tips = []
        for each in joints:
            self._configuration.update(each)
            tips.append(self._configuration.data.site(PEN_TIP).xpos.copy())
        return np.array(tips)
