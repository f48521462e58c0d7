# SPDX-License-Identifier: Apache-2.0
"""The command pf2mp-push."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_pf2mp.commands.command import given

if TYPE_CHECKING:
    from lerobot_pf2mp.hub.card_facts import PolicyFacts


@dataclass
class PushConfig:
    """Publishes a checkpoint on the Hugging Face Hub, with a model card, in one commit.

    The checkpoint is loaded first. It is not published if it is damaged, or if it is a guided policy without its potential
    field. You must be logged in (hf auth login, or the variable HF_TOKEN).

    Examples:
        pf2mp-push --path=outputs/MazeLarge-v0/pf2mp_0/checkpoints/last/pretrained_model --repo_id=you/pf2mp_maze_large
        pf2mp-push --path=outputs/dppf --repo_id=you/your_dppf --private=true --dataset=you/your_dataset \
--results=outputs/comparison --figures='[trajectories.png, rollout.mp4]'
    """

    # The checkpoint's pretrained_model folder.
    path: Path | None = None
    # Repository to publish to, user/name.
    repo_id: str | None = None
    # Whether a new repository is private.
    private: bool | None = None
    # Folder that pf2mp-benchmark has written, for a table of results; by default the checkpoint's own "results".
    results: Path | None = None
    # Images (png) and videos (mp4) for the card.
    figures: list[Path] = field(default_factory=list)
    # Name of the dataset on the Hub; by default the one that the policy was trained on.
    dataset: str | None = None
    # Classes of processor steps of a checkpoint that may be imported although they are not registered, by full names.
    trust: list[str] = field(default_factory=list)
    # Branch to publish to, created if it does not exist; by default main.
    branch: str | None = None


def main(config: PushConfig) -> None:
    """Runs the command."""
    path, repo_id = given("--path", config.path).expanduser(), given("--repo_id", config.repo_id)
    from lerobot_pf2mp.hub.publish_checkpoint import publish_checkpoint

    url = publish_checkpoint(
        path,
        repo_id,
        _loaded_facts(path),
        results=config.results and config.results.expanduser(),
        figures=[figure.expanduser() for figure in config.figures],
        dataset=config.dataset,
        private=config.private,
        branch=config.branch,
    )
    print(f"Published {config.path} at {url}.")


def _loaded_facts(path: Path) -> PolicyFacts:
    """The facts about a checkpoint for its card. All of the checkpoint is loaded, so that a damaged one is not published.

    Raises:
        ValueError: If the checkpoint is damaged, or its policy is not of this package.
        OSError: If it cannot be read.
    """
    from lerobot_pf2mp.hub.card_facts import POLICY_NAMES
    from lerobot_pf2mp.loading import load_config, load_policy, loaded_demonstrations, loaded_field
    from lerobot_pf2mp.policies.guided.configuration_guided import GuidedConfig
    from lerobot_pf2mp.policies.model_card import policy_facts

    if not path.is_dir():
        raise FileNotFoundError(f"--path must be a checkpoint's pretrained_model folder, got {path}")
    config = load_config(path, device="cpu")
    if config.type not in POLICY_NAMES:
        raise ValueError(f"the checkpoint's type must be one of {list(POLICY_NAMES)}, got {config.type!r}")
    _, preprocessor, _ = load_policy(path, device="cpu")
    if not isinstance(config, GuidedConfig):
        return policy_facts(config, None)
    loaded_field(config, preprocessor)  # raises an error if it is missing, although guidance may be off
    return policy_facts(config, loaded_demonstrations(preprocessor))
