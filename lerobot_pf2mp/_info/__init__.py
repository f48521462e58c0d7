# SPDX-License-Identifier: Apache-2.0
"""The command pf2mp-info, installed beside `lerobot_pf2mp` as the module ``pf2mp_info``.

Importing `lerobot_pf2mp` imports LeRobot and torch, and this command has to run where just that fails: nothing here imports
more than the standard library before it is known what happens.
"""
