# SPDX-License-Identifier: Apache-2.0
"""What the SO-101 task needs beyond this package."""

from __future__ import annotations

from importlib.util import find_spec

_PACKAGES = {"so101_nexus": "so101-nexus", "scservo_sdk": "feetech-servo-sdk"}


def check_so101() -> None:
    """Checks that the packages of the SO-101 task are installed.

    Raises:
        ImportError: If one is missing; the message says what to install.
    """
    missing = [name for module, name in _PACKAGES.items() if find_spec(module) is None]
    if missing:
        raise ImportError(
            f'the SO-101 task needs: pip install "lerobot_policy_pf2mp[so101]" (missing: {missing})'
        )
