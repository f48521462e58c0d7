# SPDX-License-Identifier: Apache-2.0
"""The size of rendered images."""


def image_size_of(render_size: int) -> tuple[int, int]:
    """The height and width of the images of an environment [pixels]. They are even, as video encoders require.

    Args:
        render_size: Wanted width [pixels]; the height is three quarters of it.

    Raises:
        ValueError: If the width is below 32 pixels.
    """
    if render_size < 32:
        raise ValueError(f"render_size must be at least 32 pixels, got {render_size}")
    return 2 * round(3 * render_size / 8), 2 * (render_size // 2)
