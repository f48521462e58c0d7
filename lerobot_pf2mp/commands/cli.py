# SPDX-License-Identifier: Apache-2.0
"""The entry points of the commands. Each command has its own file in `commands`.

Only the entry point of pf2mp-info is in `_info`, because that command must run even if this package cannot be imported.
"""

from lerobot_pf2mp.commands.command import run


def collect() -> None:
    """The command pf2mp-collect."""
    from lerobot_pf2mp.commands.collect import CollectConfig, main

    run(CollectConfig, main)


def train_expert() -> None:
    """The command pf2mp-train-expert."""
    from lerobot_pf2mp.commands.train_expert import TrainExpertConfig, main

    run(TrainExpertConfig, main)


def convert() -> None:
    """The command pf2mp-convert."""
    from lerobot_pf2mp.commands.convert import ConvertConfig, main

    run(ConvertConfig, main)


def fit_field() -> None:
    """The command pf2mp-fit-field."""
    from lerobot_pf2mp.commands.fit_field import FitFieldConfig, main

    run(FitFieldConfig, main)


def demo() -> None:
    """The command pf2mp-demo."""
    from lerobot_pf2mp.commands.demo import DemoConfig, main

    run(DemoConfig, main)


def benchmark() -> None:
    """The command pf2mp-benchmark."""
    from lerobot_pf2mp.commands.benchmark import BenchmarkConfig, main

    run(BenchmarkConfig, main)


def push() -> None:
    """The command pf2mp-push."""
    from lerobot_pf2mp.commands.push import PushConfig, main

    run(PushConfig, main)


def policy_server() -> None:
    """The command pf2mp-policy-server."""
    from lerobot_pf2mp.commands.policy_server import PolicyServerConfig, main

    run(PolicyServerConfig, main)


def plot() -> None:
    """The command pf2mp-plot."""
    from lerobot_pf2mp.commands.plot import PlotConfig, main

    run(PlotConfig, main)


def train() -> None:
    """The command pf2mp-train: lerobot-train with low-dimensional datasets kept in memory."""
    from lerobot_pf2mp.commands.train import main

    main()
