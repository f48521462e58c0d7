# SPDX-License-Identifier: Apache-2.0
"""Experts for Fetch, trained by reinforcement learning."""
