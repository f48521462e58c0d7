# SPDX-License-Identifier: Apache-2.0
"""The command pf2mp-policy-server."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field

POLICIES = ("fmp", "pf2mp", "dppf", "guarded")


@dataclass
class PolicyServerConfig:
    """Serves policies to remote robots by LeRobot's asynchronous inference, whose own server refuses plug-in policies.

    Needs: pip install "lerobot_policy_pf2mp[async]". The robot runs LeRobot's own client:

        python -m lerobot.async_inference.robot_client --server_address=127.0.0.1:8080 --policy_type=pf2mp \
--pretrained_name_or_path=you/your_pf2mp --actions_per_chunk=16 --robot.type=so101_follower --robot.port=/dev/ttyACM0

    LeRobot's client and server exchange pickles, so anybody who can connect to the port can run code on this machine. Let it
    listen on 127.0.0.1, the default, and use a tunnel to connect from another machine.

    One client is served at a time; another one is refused until the first has been silent for --client_timeout.

    Examples:
        pf2mp-policy-server
        pf2mp-policy-server --port=9000 --fps=10 --inference_latency=0.1
    """

    # Address to listen on.
    host: str = "127.0.0.1"
    # Port to listen on.
    port: int = 8080
    # Control frequency of the robot [Hz].
    fps: int = 30
    # Smallest time between an observation and its actions [s].
    inference_latency: float = 1 / 30
    # Longest wait for an observation [s].
    obs_queue_timeout: float = 2.0
    # Time after which a silent client is taken to have left, so that another one may come [s].
    client_timeout: float = 30.0
    # Classes of processor steps of a checkpoint that may be imported although they are not registered, by full names.
    trust: list[str] = field(default_factory=list)


def main(config: PolicyServerConfig) -> None:
    """Runs the command."""
    if config.fps < 1:
        raise ValueError(f"fps must be at least 1 Hz, got {config.fps}")
    if not (config.client_timeout > 0 and math.isfinite(config.client_timeout)):
        raise ValueError(f"client_timeout must be finite and above 0 s, got {config.client_timeout:g}")
    try:
        from lerobot.async_inference import configs, constants

        from lerobot_pf2mp.serving import serve
    except ImportError as error:
        raise ImportError(
            f'pf2mp-policy-server needs: pip install "lerobot_policy_pf2mp[async]" ({error})'
        ) from error
    options = {key: value for key, value in asdict(config).items() if key not in ("client_timeout", "trust")}
    # The server checks the policy type against this list.
    constants.SUPPORTED_POLICIES.extend(
        policy for policy in POLICIES if policy not in constants.SUPPORTED_POLICIES
    )
    serve(configs.PolicyServerConfig(**options), config.client_timeout)
