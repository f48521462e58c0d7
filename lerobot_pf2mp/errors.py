# SPDX-License-Identifier: Apache-2.0
"""The one error type of this package, everything else raises Python's own; and how errors reach the user."""

from collections.abc import Iterator
from contextlib import contextmanager

from draccus.utils import ParsingError
from huggingface_hub.errors import HfHubHTTPError


class ConfigError(ParsingError):
    """A value of a configuration breaks its rule.

    Deliberately no ValueError: LeRobot's command line replaces those by "Couldn't instantiate class" and drops the
    reason, whereas it prints the message of an error of this type.
    """


@contextmanager
def reported_on_the_command_line() -> Iterator[None]:
    """Turns a ValueError or OSError of the block into a `ConfigError` with the same message."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise ConfigError(str(error)) from error


@contextmanager
def explained(what: str) -> Iterator[None]:
    """Turns any error of the block, of whichever library, into one of Python's own that says what could not be done.

    Args:
        what: What failed, for example "the checkpoint outputs/pf2mp cannot be loaded".

    Raises:
        OSError: For an OSError.
        ValueError: For any other error.
    """
    try:
        yield
    except OSError as error:
        raise OSError(f"{what}: {_said_by(error)}") from error
    except Exception as error:
        raise ValueError(f"{what}: {_said_by(error)}") from error


def _said_by(error: Exception) -> str:
    text = str(error) or type(error).__name__
    # LeRobot says that a file is not on the Hub whatever the Hub has answered, also that nobody is logged in.
    return f"{text}: {error.__cause__}" if isinstance(error.__cause__, HfHubHTTPError) else text
