# SPDX-License-Identifier: Apache-2.0
"""The sizes of images that a policy was made for."""

from __future__ import annotations

from typing import Any


def check_image_sizes(config: Any, batch: dict[str, Any]) -> None:
    """Checks that a batch's images have the size that the policy was made for, where that matters.

    With ``resize_shape`` it does not, and with ``crop_shape`` they must be large enough. So does a checkpoint fit cameras of
    another size, for example when it is fine-tuned.

    Args:
        config: The policy's configuration.
        batch: Observations, with images ``(..., C, H, W)`` by camera.

    Raises:
        ValueError: If an image has another size. It names both.
    """
    if config.resize_shape is not None:
        return
    for key, feature in config.image_features.items():
        if key not in batch:  # they are stacked already
            continue
        size, made_for = tuple(batch[key].shape[-3:]), tuple(feature.shape)
        crop = config.crop_shape
        if size == made_for or (crop is not None and size[1] >= crop[0] and size[2] >= crop[1]):
            continue
        raise ValueError(
            f"images of {key} must be of {made_for[1]} x {made_for[2]} pixels, for which this policy was made, got "
            f"{size[1]} x {size[2]}: resize the images, or train a policy with --policy.resize_shape, which fits any size"
        )
