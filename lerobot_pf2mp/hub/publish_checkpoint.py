# SPDX-License-Identifier: Apache-2.0
"""Publishes a checkpoint on the Hugging Face Hub, with a card, results and figures."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_pf2mp.hub.card_facts import CardFacts, PolicyFacts
from lerobot_pf2mp.hub.model_card import env_options, make_model_card
from lerobot_pf2mp.hub.publishing import check_destination, publish
from lerobot_pf2mp.results.rows import SummaryRow, read_rows

_SUFFIXES = {".safetensors", ".json", ".yaml"}
_FIGURE_SUFFIXES = (".png", ".mp4")
_RESULTS_FILES = ("summary.csv", "table.md", "run.json")


@dataclass(frozen=True)
class _Results:
    """The results of a benchmark for a card."""

    table: str
    made_with: Mapping[str, str]
    env_options: Sequence[str]


def publish_checkpoint(
    path: Path,
    repo_id: str,
    policy: PolicyFacts,
    *,
    results: Path | None = None,
    figures: Sequence[Path] = (),
    dataset: str | None = None,
    private: bool | None = None,
    branch: str | None = None,
) -> str:
    """Publishes a policy with its processors, field, card, results and figures, in one commit.

    Args:
        path: The checkpoint's ``pretrained_model`` folder.
        repo_id: The repository, ``user/name``.
        policy: The facts about the policy for the card.
        results: A folder that `run_benchmark` has written; None for ``results`` in the checkpoint, if that exists.
        figures: Images and videos for the card.
        dataset: Name of the dataset on the Hub; None for the one named in the checkpoint's training configuration.
        private: Whether a new repository is private; None for the Hub's default.
        branch: Branch, created if it does not exist; None for main.

    Returns:
        The repository's address.

    Raises:
        ValueError: If an argument breaks its rule.
        OSError: If a file cannot be read, or the Hub cannot be reached or refuses.
    """
    files: dict[str, Path | bytes] = {
        file.name: file
        for file in sorted(path.iterdir())
        if file.suffix in _SUFFIXES and file.is_file() and not file.name.startswith(".")
    }
    if results is None and (path / "results").is_dir():
        results = path / "results"
    found = None if results is None else _read_results(results)
    if results is not None:
        files.update({f"results/{name}": results / name for name in _RESULTS_FILES})
    for figure in figures:
        path_in_repo = f"figures/{figure.name}"
        if figure.suffix not in _FIGURE_SUFFIXES or not figure.is_file():
            raise ValueError(f"--figures must be files ending in {_FIGURE_SUFFIXES}, got {figure}")
        if path_in_repo in files:
            raise ValueError(f"--figures must have names of their own, got {figure.name} twice")
        files[path_in_repo] = figure

    training = _read_training(path)
    card = make_model_card(
        CardFacts(
            policy=policy,
            repo_id=check_destination(repo_id),
            dataset=dataset or training.get("dataset", {}).get("repo_id"),
            training=training,
            env_options=env_options(training.get("env")) or (found.env_options if found else ()),
            table=found.table if found else None,
            made_with=found.made_with if found else {},
            figures=[name for name in files if name.startswith("figures/")],
        )
    )
    files["README.md"] = str(card).encode()
    message = f"Upload {policy.type} policy with processors and card"
    return publish(repo_id, "model", files, message=message, private=private, branch=branch)


def _read_training(path: Path) -> dict[str, Any]:
    """The checkpoint's training configuration; empty if it has none, as after `fit_field`."""
    file = path / "train_config.json"
    return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}


def _read_results(folder: Path) -> _Results:
    missing = [name for name in _RESULTS_FILES if not (folder / name).is_file()]
    if missing:
        raise FileNotFoundError(
            f"--results must be a folder that pf2mp-benchmark has written, got {folder} without {missing}"
        )
    rows = read_rows(folder / "summary.csv", SummaryRow)
    try:
        run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        env, made_with = run["episodes"]["env"], run["made_with"]
    except (ValueError, KeyError) as error:
        raise ValueError(
            f"{folder / 'run.json'} must be one that pf2mp-benchmark has written: {error}"
        ) from error
    tasks = {row.task for row in rows}
    if len(tasks) == 1:
        env = {**env, "task": tasks.pop()}
    table = (folder / "table.md").read_text(encoding="utf-8")
    return _Results(table, made_with, env_options(env))
