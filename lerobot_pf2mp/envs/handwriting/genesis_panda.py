# SPDX-License-Identifier: Apache-2.0
"""Many Franka Pandas with pens at tables, in one scene of Genesis. The arm is the one that Genesis ships."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import torch

from lerobot_pf2mp.envs.handwriting.panda import FORCES, LAG, N_ARM_JOINTS, PEN, STIFFNESS
from lerobot_pf2mp.envs.handwriting.panda_frames import from_standard, to_standard
from lerobot_pf2mp.envs.handwriting.pen import add_pen
from lerobot_pf2mp.envs.handwriting.writing_model import TABLE_CENTRE, TABLE_SIZE

try:
    import genesis as gs
except ModuleNotFoundError as error:
    raise ImportError('the simulator genesis needs: pip install "lerobot_policy_pf2mp[genesis]"') from error

_ARM = "xml/franka_emika_panda/panda.xml"
_STEPS_BETWEEN_TIPS = 5  # physics steps, as in MuJoCo


class GenesisPandas:
    """Pandas that write, each at a table of its own: the `Arms` of Genesis.

    The position controllers have the same gains as in MuJoCo, and gravity is compensated there, too.

    Args:
        n_arms: How many there are.
    """

    timestep = 0.002  # as in MuJoCo

    def __init__(self, n_arms: int) -> None:
        if not gs._initialized:
            gs.init(backend=gs.cpu, logging_level="error")
        self._scene = gs.Scene(
            sim_options=gs.options.SimOptions(dt=self.timestep),
            rigid_options=gs.options.RigidOptions(enable_self_collision=False),
            show_viewer=False,
        )
        self._arm = self._scene.add_entity(
            gs.morphs.MJCF(file=arm_with_pen()), material=gs.materials.Rigid(gravity_compensation=1.0)
        )
        length, width, height = TABLE_SIZE
        self._table = self._scene.add_entity(
            gs.morphs.Box(pos=(*TABLE_CENTRE, -height / 2), size=(length, width, height), fixed=True)
        )
        self._scene.build(n_envs=n_arms)
        self._hand = self._arm.get_link("link7").idx_local
        joints = list(range(N_ARM_JOINTS))
        stiffness, force = np.array(STIFFNESS), np.array(FORCES)
        self._arm.set_dofs_kp(stiffness, joints)
        self._arm.set_dofs_kv(stiffness * LAG, joints)
        self._arm.set_dofs_force_range(-force, force, joints)

    def place(self, joints: np.ndarray) -> None:
        """Puts all arms at rest at joint positions ``(n_arms, 9)`` [rad; m]."""
        self._scene.reset()
        standard = torch.as_tensor(to_standard(joints), dtype=torch.float32)
        self._arm.set_dofs_position(standard)
        self._arm.control_dofs_position(standard)
        self._target = joints.copy()

    def drive(self, target: np.ndarray, n_steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Drives all arms towards joint positions, see `Arms.drive`."""
        before, tips = self._target, [self.tips()]
        has_touched = np.zeros(len(target), dtype=bool)
        for step in range(1, n_steps + 1):
            set_points = to_standard(before + step / n_steps * (target - before))
            self._arm.control_dofs_position(torch.as_tensor(set_points, dtype=torch.float32))
            self._scene.step()
            if step % _STEPS_BETWEEN_TIPS == 0 or step == n_steps:
                tips.append(self.tips())
            has_touched |= self._touch_the_table()
        self._target = target.copy()
        return np.stack(tips, axis=1), has_touched

    def joints(self) -> np.ndarray:
        """The measured joint positions ``(n_arms, 9)`` [rad; m]."""
        return from_standard(self._arm.get_dofs_position().cpu().numpy().astype(np.float64))

    def tips(self) -> np.ndarray:
        """The positions ``(n_arms, 3)`` of the pens' tips [m]."""
        position = self._arm.get_links_pos([self._hand])[:, 0].cpu().numpy().astype(np.float64)
        w, x, y, z = self._arm.get_links_quat([self._hand])[:, 0].cpu().numpy().astype(np.float64).T
        axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x**2 + y**2)], axis=1)
        return position + PEN[1] * axis

    def close(self) -> None:
        """Frees the scene."""
        self._scene.destroy()

    def _touch_the_table(self) -> np.ndarray:
        contacts = self._arm.get_contacts(with_entity=self._table, is_padded=True)
        return contacts["valid_mask"].any(dim=-1).cpu().numpy()


def arm_with_pen() -> str:
    """Genesis' model of the arm, with the same pen as in MuJoCo."""
    file = Path(gs.utils.get_assets_dir()) / _ARM
    spec = mujoco.MjSpec.from_file(str(file))
    spec.compiler.meshdir = spec.meshdir = str(file.parent / "assets")
    add_pen(spec.body("link7"), "z", *PEN)
    return spec.to_xml()
