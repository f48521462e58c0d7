# SPDX-License-Identifier: Apache-2.0
"""The report on a potential field as one page, which opens without a network, with its figures and numbers beside it."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from html import escape
from pathlib import Path

from lerobot_pf2mp import __version__
from lerobot_pf2mp.field_report.report import FieldReport
from lerobot_pf2mp.figures.support import count_of_episodes, plot_dimensions, plot_support
from lerobot_pf2mp.figures.theme import THEMES

# A folder with this file is a report.
REPORT_MARK = "report.json"

_FIGURES: dict[str, tuple[Callable[..., None], str, str]] = {
    "support": (
        plot_support,
        "Support of the episodes",
        "Each episode is judged by a field and a safe set made without it. Left: the share of its actions outside the safe "
        "set of the others. Right: its worst action, as log density above the border of the safe set. An episode with most "
        "of its actions outside is alone: it went where no other did, or something went wrong in it.",
    ),
    "dimensions": (
        plot_dimensions,
        "Dimensions that carry the distance",
        "The kernels are as wide in every dimension. A dimension with a large share decides alone what counts as near; one "
        "with hardly any share, such as a gripper, can be left out with field_action_dims.",
    ),
}
_N_LISTED = 20  # outlying frames on the page

_STYLE = """
:root { color-scheme: light dark; --back: #ffffff; --text: #1f2328; --soft: #59636e; --line: #d9dee3; --panel: #f6f8fa;
  --good: #1f7a4a; --bad: #b3261e; --open: #7a5c00; }
@media (prefers-color-scheme: dark) { :root { --back: #0d1117; --text: #e6edf3; --soft: #9198a1; --line: #30363d;
  --panel: #161b22; --good: #4cc38a; --bad: #ff8a80; --open: #e3b341; } }
body { background: var(--back); color: var(--text); font: 16px/1.5 system-ui, sans-serif; max-width: 900px;
  margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin-bottom: 0; } h2 { font-size: 1.15rem; margin-top: 2rem; }
.source, .note, footer { color: var(--soft); } .note { margin-top: 0.2rem; }
footer { margin-top: 2.5rem; font-size: 0.85rem; }
.verdict { border-left: 6px solid var(--open); background: var(--panel); padding: 0.8rem 1rem; font-size: 1.1rem; }
.verdict.good { border-color: var(--good); } .verdict.bad { border-color: var(--bad); }
.wide { overflow-x: auto; } table { border-collapse: collapse; width: 100%; }
th, td { text-align: left; padding: 0.35rem 0.7rem 0.35rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { white-space: nowrap; }
td.number { text-align: right; white-space: nowrap; } th.number { text-align: right; }
img { max-width: 100%; height: auto; }
"""


def write_report(report: FieldReport, folder: Path) -> None:
    """Writes ``report.html``, ``report.json`` and the figures, for light and dark backgrounds, into a new folder.

    Args:
        report: The numbers.
        folder: The folder, which must not exist.
    """
    folder.mkdir()
    for name, (draw, *_) in _FIGURES.items():
        for background in THEMES:
            draw(folder / f"{name}_{background}.png", report=report, background=background)
    (folder / "report.json").write_text(json.dumps(report.as_json(), indent=2) + "\n", encoding="utf-8")
    (folder / "report.html").write_text(_page(report, folder), encoding="utf-8")


def _page(report: FieldReport, folder: Path) -> str:
    mood = {True: "good", False: "bad", None: "open"}[report.is_enough]
    remark = f"<p>{escape(report.remark)}</p>" if report.remark else ""
    figures = "".join(
        f"<h2>{escape(title)}</h2><p class='note'>{escape(text)}</p>{_picture(folder, name, title)}"
        for name, (_, title, text) in _FIGURES.items()
    )
    return (
        "<!DOCTYPE html>\n<html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width, initial-scale=1'>"
        f"<title>Potential field of {escape(report.source)}</title><style>{_STYLE}</style></head>\n<body>"
        f"<h1>Potential field</h1><p class='source'>{escape(report.source)}</p>"
        f"<p class='verdict {mood}'>{escape(report.verdict)}</p>{remark}"
        f"<h2>Numbers</h2><div class='wide'><table>{_numbers(report)}</table></div>"
        f"{figures}{_outlying(report)}"
        f"<footer>Lengths are in the normalised units of the policy's actions. Written by lerobot_pf2mp {__version__}; the "
        "same numbers are in report.json.</footer></body></html>\n"
    )


def _numbers(report: FieldReport) -> str:
    low, median, high = report.effective_anchors
    share = (
        f" ({100 * report.reach / report.spread:.3g} % of the actions' spread)" if report.spread > 0 else ""
    )
    rows = [
        ("Bandwidth h", f"{report.bandwidth:.4g}", "width of the kernels"),
        (
            "Threshold",
            f"{report.log_threshold:.4g} nats",
            f"log density at the border of the safe set, which leaves out {100 * report.threshold_quantile:.3g} % of the "
            "demonstrated actions",
        ),
        (
            "Reach",
            f"{report.reach:.3g}",
            f"of the safe set from an action that is far from all others{share}",
        ),
        ("Frames", f"{report.n_frames}", f"looked at, of {count_of_episodes(report)}"),
        ("Anchors", f"{report.n_anchors}", "demonstrated actions that make up the field"),
        (
            "Anchors that count",
            f"{median:.3g}",
            f"at an action (median of 1 / sum w²; {low:.3g} to {high:.3g} in 80 % of cases). With less than 2, one "
            "demonstration alone says where to go",
        ),
        ("Outlying frames", f"{len(report.outlying)}", "far from all others"),
    ]
    if report.action_kind is not None:
        kind = report.action_kind
        rows.append(
            (
                "Actions and state",
                f"{kind.with_states:.2f}",
                f"rank correlation with the state, {kind.with_changes:.2f} with its change: they "
                + (
                    "look like positions"
                    if kind.are_positions
                    else "do NOT look like positions, which a field needs"
                ),
            )
        )
    return "".join(
        f"<tr><th>{escape(name)}</th><td class='number'>{escape(value)}</td><td>{escape(text)}</td></tr>"
        for name, value, text in rows
    )


def _picture(folder: Path, name: str, title: str) -> str:
    light, dark = (_data(folder / f"{name}_{background}.png") for background in ("light", "dark"))
    return (
        f"<picture><source media='(prefers-color-scheme: dark)' srcset='{dark}'>"
        f"<img alt='{escape(title)}' src='{light}'></picture>"
    )


def _data(path: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"


def _outlying(report: FieldReport) -> str:
    if not report.outlying:
        return ""
    rows = "".join(
        f"<tr><td>{'unknown' if frame.episode is None else frame.episode}</td><td>{frame.frame}</td>"
        f"<td class='number'>{frame.distance:.3g}</td><td class='number'>{frame.bandwidths:.3g}</td></tr>"
        for frame in report.outlying[:_N_LISTED]
    )
    more = len(report.outlying) - _N_LISTED
    return (
        "<h2>Outlying frames</h2><p class='note'>Their actions are far from all others, as wrong values of a sensor are. "
        "They are left out of the field, but not of the statistics that normalise actions.</p><div class='wide'><table>"
        "<tr><th>episode</th><th>frame of the dataset</th><th class='number'>distance to another episode</th>"
        f"<th class='number'>in bandwidths</th></tr>{rows}</table></div>"
        + (f"<p class='note'>{more} more are in report.json.</p>" if more > 0 else "")
    )
