# SPDX-License-Identifier: Apache-2.0
"""LeRobot's policy server for asynchronous inference, with checked checkpoints and one client at a time."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import grpc
from draccus.utils import ParsingError
from lerobot.async_inference import policy_server
from lerobot.policies import make_pre_post_processors

from lerobot_pf2mp.policies.processor_files import check_processors


class OneClientPolicyServer(policy_server.PolicyServer):
    """Serves one policy to one client.

    LeRobot's server keeps a single policy, queue and clock. A second client would replace the policy of the first one, and
    get plans for the first one's observations. Here it is refused until the first one has been silent for a while.

    Args:
        config: LeRobot's configuration of the server.
        client_timeout: The time after which a silent client is taken to have left [s].
    """

    def __init__(self, config: Any, client_timeout: float) -> None:
        super().__init__(config)
        self._client_timeout = client_timeout
        self._client = ""
        self._last_heard = 0.0
        self._admission = threading.Lock()

    def Ready(self, request: Any, context: Any) -> Any:  # noqa: N802, D102  LeRobot's name
        self._admit(context)
        return super().Ready(request, context)

    def SendPolicyInstructions(self, request: Any, context: Any) -> Any:  # noqa: N802, D102
        self._admit(context)
        with _reported_to(context, self.logger):
            try:
                return super().SendPolicyInstructions(request, context)
            except BaseException:
                self.policy = None  # its weights may be there already, without its processors
                raise

    def SendObservations(self, request_iterator: Iterator[Any], context: Any) -> Any:  # noqa: N802, D102
        self._admit(context)
        return super().SendObservations(request_iterator, context)

    def GetActions(self, request: Any, context: Any) -> Any:  # noqa: N802, D102
        self._admit(context)
        return super().GetActions(request, context)

    def _admit(self, context: Any) -> None:
        """Ends the call of another client than the one that is served."""
        client, now = context.peer(), time.monotonic()
        with self._admission:
            is_free = not self._client or now - self._last_heard > self._client_timeout
            if is_free or client == self._client:
                self._client, self._last_heard = client, now
                return
            message = (
                f"this server serves one client at a time, and {self._client} was heard {now - self._last_heard:.1f} s ago: "
                f"start another server for {client}, or wait until it has been silent for {self._client_timeout:g} s"
            )
        self.logger.error(message)
        context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, message)


@contextmanager
def _reported_to(context: Any, logger: Any) -> Iterator[None]:
    """Tells the client, and the log, in one line what was wrong with what it asked for."""
    try:
        yield
    except (ParsingError, ValueError, TypeError, OSError, ImportError, RuntimeError) as error:
        message = " ".join(str(error).split())
        logger.error(message)
        context.abort(grpc.StatusCode.INVALID_ARGUMENT, message)


def serve(config: Any, client_timeout: float) -> None:
    """Starts the server, which checks processors before it loads them, and waits until it ends.

    Args:
        config: LeRobot's configuration of the server.
        client_timeout: See `OneClientPolicyServer`.
    """

    def make_server(server_config: Any) -> OneClientPolicyServer:
        return OneClientPolicyServer(server_config, client_timeout)

    # LeRobot's module makes its server, and loads processors, by these names.
    policy_server.PolicyServer = make_server
    policy_server.make_pre_post_processors = load_checked_processors
    policy_server.serve(config)


def load_checked_processors(config: Any, pretrained_path: str, **options: Any) -> Any:
    """LeRobot's `make_pre_post_processors` of a checkpoint, after `check_processors`."""
    check_processors(pretrained_path, must_exist=True)
    return make_pre_post_processors(config, pretrained_path=pretrained_path, **options)
