# SPDX-License-Identifier: Apache-2.0
"""The command pf2mp-info, installed beside `lerobot_pf2mp` as the module ``pf2mp_info``.

Nearly everything in `lerobot_pf2mp` imports LeRobot and torch. This command must also run where that import fails. So its
modules import only the standard library; everything else is imported in the probes, where an error is reported.
"""
