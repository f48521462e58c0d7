# SPDX-License-Identifier: Apache-2.0
"""Gymnasium environments that report collisions, and their LeRobot configurations, by task.

They are registered under ``lerobot_pf2mp/<task>``; MuJoCo is imported when one is made.
"""
