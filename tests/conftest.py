# SPDX-License-Identifier: Apache-2.0
import os
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


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)
