# SPDX-License-Identifier: Apache-2.0
"""The size of rendered pictures."""


def picture_size_of(render_size: int) -> tuple[int, int]:
    """Height and width of the pictures of an environment [pixels], even numbers as video encoders want them.

    Raises:
        ValueError: If the width asked for is too small.
    """
    if render_size < 32:
        raise ValueError(f"render_size must be at least 32 pixels, got {render_size}")
    return 2 * round(3 * render_size / 8), 2 * (render_size // 2)
