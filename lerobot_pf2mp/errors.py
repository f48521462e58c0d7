# SPDX-License-Identifier: Apache-2.0
"""The only error type of this package, and how errors reach the user. All other errors are Python's own."""

from collections.abc import Iterator
from contextlib import contextmanager

from draccus.utils import ParsingError
from huggingface_hub.errors import HfHubHTTPError


class ConfigError(ParsingError):
    """A value of a configuration breaks its rule.

    Deliberately not a ValueError: LeRobot's command line replaces a ValueError by "Couldn't instantiate class" and drops
    the reason. It prints the message of an error of this type.
    """


@contextmanager
def reported_on_the_command_line() -> Iterator[None]:
    """Turns a ValueError, OSError or ImportError of a `with` block into a `ConfigError` with the same message."""
    try:
        yield
    except (ValueError, OSError, ImportError) as error:
        raise ConfigError(str(error)) from error


@contextmanager
def explained(what: str) -> Iterator[None]:
    """Turns any error of a `with` block, from any library, into one of Python's own that says what could not be done.

    Args:
        what: What failed, for example "the checkpoint outputs/pf2mp cannot be loaded".

    Raises:
        OSError: For an OSError.
        ValueError: For any other error.
    """
    try:
        yield
    except OSError as error:
        raise OSError(f"{what}: {_message_of(error)}") from error
    except Exception as error:
        raise ValueError(f"{what}: {_message_of(error)}") from error


def _message_of(error: Exception) -> str:
    text = str(error) or type(error).__name__
    # LeRobot reports "not found on the Hub" for every error of the Hub, for example a missing login, and datasets "an error
    # occurred" for a full disk. The cause says more.
    cause = error.__cause__
    is_told = isinstance(cause, HfHubHTTPError) or (isinstance(cause, OSError) and str(cause) not in text)
    return f"{text}: {cause}" if is_told else text
