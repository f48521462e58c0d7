# SPDX-License-Identifier: Apache-2.0
import os
from collections import Counter
from pathlib import Path

# Programs of Python that tests start must not find this checkout's package in front of the installed one.
os.environ["PYTHONSAFEPATH"] = "1"
os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("MPLBACKEND", "Agg")
# Small tensors: more threads only wait for each other, here and in the commands that tests start.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch

import lerobot_pf2mp


def pytest_report_header() -> str:
    return f"lerobot_pf2mp: {Path(lerobot_pf2mp.__file__).parent}"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts the files with most slow tests first, so that of two processes none has much left when the other has ended."""
    n_slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -n_slow[item.path])


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)
