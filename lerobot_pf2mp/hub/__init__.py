# SPDX-License-Identifier: Apache-2.0
"""Publishes checkpoints and datasets on the Hugging Face Hub."""
