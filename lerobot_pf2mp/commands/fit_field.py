# SPDX-License-Identifier: Apache-2.0
"""The command pf2mp-fit-field."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

from lerobot_pf2mp.commands.command import given


@dataclass
class FitFieldPolicyConfig:
    """The policy that gets a field, and changes to its options. Unset ones keep the checkpoint's or the default value."""

    # The checkpoint's pretrained_model folder, or a repository user/name on the Hub.
    path: str | None = None
    # Branch, tag or commit on the Hub.
    revision: str | None = None
    # lambda, the strength of the guidance.
    guidance_scale: float | None = None
    # proximal or euler.
    guidance_integrator: str | None = None
    # Demonstrated actions kept as anchors of the field.
    n_field_points: int | None = None
    # Action dimensions that the field covers; by default all.
    field_action_dims: tuple[int, ...] | None = None
    # Kernel bandwidth [normalised action units], or likelihood, scott or silverman.
    field_bandwidth: float | str | None = None
    # Quantile of the anchors' own densities above which an action counts as safe.
    field_threshold_quantile: float | None = None
    # Weight of the distance to the safe set, at most 0.
    field_alpha: float | None = None


@dataclass
class FitFieldDatasetConfig:
    """The dataset to whose actions the field is fitted."""

    # Name of the LeRobotDataset, user/name.
    repo_id: str | None = None
    # Its folder; by default LeRobot's cache, filled from the Hub.
    root: Path | None = None
    # Branch, tag or commit on the Hub.
    revision: str | None = None
    # Episodes to use; all by default.
    episodes: list[int] | None = None


@dataclass
class FitFieldConfig:
    """Gives a trained policy a potential field without retraining: diffusion becomes dppf, fmp becomes pf2mp.

    A pf2mp or dppf policy gets a new field. The new checkpoint works with lerobot-eval, lerobot-train and lerobot-rollout.

    Examples:
        pf2mp-fit-field --policy.path=outputs/diffusion/checkpoints/last/pretrained_model \
--dataset.repo_id=you/your_dataset --output_dir=outputs/dppf
        pf2mp-fit-field --policy.path=you/your_fmp --policy.n_field_points=10000 --dataset.repo_id=you/your_dataset \
--output_dir=outputs/pf2mp
    """

    # The policy that gets a field.
    policy: FitFieldPolicyConfig = field(default_factory=FitFieldPolicyConfig)
    # The dataset of demonstrations.
    dataset: FitFieldDatasetConfig = field(default_factory=FitFieldDatasetConfig)
    # Folder of the new checkpoint.
    output_dir: Path | None = None
    # Whether to replace an existing checkpoint.
    overwrite: bool = False


def main(config: FitFieldConfig) -> None:
    """Runs the command."""
    policy, dataset = config.policy, config.dataset
    path = given("--policy.path", policy.path)
    repo_id = given("--dataset.repo_id", dataset.repo_id)
    output_dir = given("--output_dir", config.output_dir)
    from lerobot_pf2mp.fit_field import fit_field

    changed = {name: value for name, value in asdict(policy).items() if value is not None}
    del changed["path"]
    revision = changed.pop("revision", None)
    fitted = fit_field(
        Path(path).expanduser() if Path(path).expanduser().is_dir() else path,
        output_dir.expanduser(),
        repo_id=repo_id,
        root=dataset.root and dataset.root.expanduser(),
        episodes=dataset.episodes,
        dataset_revision=dataset.revision,
        checkpoint_revision=revision,
        options=changed,
        overwrite=config.overwrite,
    )
    print(f"Wrote a {fitted.type} checkpoint to {output_dir}.")
