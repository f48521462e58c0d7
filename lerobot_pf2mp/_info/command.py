# SPDX-License-Identifier: Apache-2.0
"""The command pf2mp-info."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field
from importlib.metadata import version

from .checkpoint import checkpoint_lines
from .probes import DISTRIBUTION
from .report import as_json, as_row, gather, is_well, verdict


@dataclass
class CheckpointConfig:
    """A checkpoint to report on."""

    # Its pretrained_model folder, or a repository on the Hub.
    path: str = ""
    # Classes of processor steps that may be imported although they are not registered, by their full names.
    trust: list[str] = field(default_factory=list)


@dataclass
class InfoConfig:
    """Reports what is installed, whether LeRobot finds this package, what works here, and how to repair the rest.

    With --policy.path it reports what a checkpoint holds instead: its potential field, and how its plans are checked.

    Each line ends in ok, optional (missing, but needed only for the feature that the line names) or problem. The exit code
    is 0 if there is no problem, else 1.

    Examples:
        pf2mp-info
        pf2mp-info --json=true > info.json
        pf2mp-info --policy.path=outputs/MazeLarge-v0/pf2mp_0/checkpoints/last/pretrained_model
    """

    # Whether to write JSON, for issue reports, instead of a table.
    json: bool = False
    # Largest duration of each trial [s].
    time_limit: float = 120.0
    # A checkpoint to report on instead.
    policy: CheckpointConfig = field(default_factory=CheckpointConfig)


def main() -> None:
    """The entry point."""
    if sys.argv[1:] == ["--version"]:
        print(f"pf2mp-info {version(DISTRIBUTION)}")
        return
    config = _parsed()
    lines = []
    try:
        path = config.policy.path
        for line in checkpoint_lines(path, config.policy.trust) if path else gather(config.time_limit):
            lines.append(line)
            if not config.json:
                print(as_row(line), flush=True)
    except KeyboardInterrupt:
        sys.exit(130)
    print(as_json(lines) if config.json else verdict(lines))
    sys.exit(0 if is_well(lines) else 1)


def _parsed() -> InfoConfig:
    try:
        import draccus
    except Exception:
        # draccus comes with LeRobot. Without it the report is needed most, so one option is read here.
        return InfoConfig(json="--json=true" in sys.argv[1:])
    try:
        from lerobot_pf2mp.commands.options import parse as parse_as_typed
    except Exception:  # the package is what is to be reported on
        parse_as_typed = draccus.parse  # type: ignore[assignment]
    try:
        config = parse_as_typed(InfoConfig)
        if not 0 < config.time_limit < math.inf:
            raise draccus.ParsingError(
                f"time_limit must be finite and above 0 [s], got {config.time_limit:g}"
            )
    except (draccus.utils.DecodingError, draccus.utils.ParsingError, OSError) as error:
        print("error:", " ".join(str(error).split()), file=sys.stderr)
        sys.exit(1)
    return config
