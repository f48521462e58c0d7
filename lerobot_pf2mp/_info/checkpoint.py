# SPDX-License-Identifier: Apache-2.0
"""What a checkpoint holds: its policy, its potential field, and how its plans are checked."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from typing import Any

from .line import OPTIONAL, PROBLEM, Line
from .probes import message_of


def checkpoint_lines(path: str, trust: Sequence[str] = ()) -> Iterator[Line]:
    """The lines of a checkpoint, which is loaded as a whole.

    Args:
        path: Its ``pretrained_model`` folder, or a repository on the Hub.
        trust: Classes of processor steps that may be imported although they are not registered.
    """
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)  # each finding is a line of the report
    try:
        yield from _lines(path, trust)
    finally:
        logging.disable(level)


def _lines(path: str, trust: Sequence[str]) -> Iterator[Line]:
    try:
        from lerobot_pf2mp import load_policy

        with redirect_stdout(sys.stderr):  # LeRobot prints; this command's own output may be JSON
            policy, preprocessor, _ = load_policy(path, device="cpu", trust=trust)
    except Exception as error:
        yield Line("policy", "cannot be loaded", PROBLEM, message_of(error, longest=1000))
        return
    config = policy.config
    yield Line("processors", "registered or trusted steps only")
    yield Line("policy", f"{config.type}, chunks of {config.n_action_steps} actions")
    if not hasattr(config, "guidance_scale"):
        yield Line(
            "field", "none", OPTIONAL, "pf2mp-fit-field gives a field to policies of type fmp and diffusion"
        )
        return
    try:
        yield from _field_lines(config, preprocessor)
    except Exception as error:
        yield Line("field", "cannot be used", PROBLEM, message_of(error))


def _field_lines(config: Any, preprocessor: Any) -> Iterator[Line]:
    from lerobot_pf2mp.loading import loaded_demonstrations, loaded_field
    from lerobot_pf2mp.policies.guided.field_settings import INTEGRATED

    field, demonstrations = loaded_field(config, preprocessor), loaded_demonstrations(preprocessor)
    episodes = demonstrations.episodes
    from_episodes = "" if episodes is None else f" of {len(episodes.unique())} episodes"
    yield Line(
        "field",
        f"{len(field.anchors)} anchors{from_episodes} in {field.dim} dimensions, h = {field.bandwidth:.4g}, safe set: "
        f"log density above {field.log_threshold:.4g}",
    )
    region = demonstrations.region(config.field_settings)
    where = region if region == "everywhere" else f"{region}, quantile {config.guidance_quantile:g}"
    yield Line("guidance", f"{config.guidance_integrator}, lambda = {config.guidance_scale:g}, {where}")
    try:
        threshold = demonstrations.plan_threshold(
            config.field_settings, config.n_action_steps, config.false_alarm_rate
        )
    except ValueError as error:
        status = PROBLEM if config.on_unsupported != "ignore" else OPTIONAL
        yield Line("plans", "not checked", status, message_of(error))
        return
    done = f"up to {config.max_plans} drawn, on_unsupported={config.on_unsupported}"
    if not config.checks_plans:
        done = "not checked: max_plans=1, on_unsupported=ignore"
    yield Line(
        "plans",
        f"log density on the way above {threshold.log_density:.4g}, calibrated on {threshold.n_plans} demonstrated plans; "
        f"at most {100 * threshold.false_alarm_rate:.2g} % false alarms; {done}",
    )
    if config.field_over == INTEGRATED:
        yield Line(
            "way of a plan",
            "begins at the observed state, and goes along the running sum of the actions, "
            f"{config.field_displacement_scale:g} units of state per unit of action",
        )
        return
    place = (
        "the observed state"
        if demonstrations.starts_at_state(config.field_settings)
        else ("the first action, as the observed state is not in the units of the actions")
    )
    yield Line("way of a plan", f"begins at the last executed action; in the first plan at {place}")
