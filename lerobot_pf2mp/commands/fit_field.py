# SPDX-License-Identifier: Apache-2.0
"""The command pf2mp-fit-field."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_pf2mp.commands.command import given

if TYPE_CHECKING:
    from lerobot_pf2mp.field_report.report import FieldReport


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
    # Where the field pulls: everywhere, unsupported or fading.
    guidance_region: str | None = None
    # Quantile of the demonstrated actions' densities above which it does not.
    guidance_quantile: float | None = None
    # Largest number of plans drawn for one that is executed.
    max_plans: int | None = None
    # Largest probability with which a plan as good as a fresh demonstration is flagged.
    false_alarm_rate: float | None = None
    # What happens if the best of these plans is still flagged: ignore, warn, hold or stop.
    on_unsupported: str | None = None
    # Demonstrated actions kept as anchors of the field.
    n_field_points: int | None = None
    # Action dimensions that the field covers; by default all.
    field_action_dims: tuple[int, ...] | None = None
    # Kernel bandwidth [normalised action units], or likelihood, scott or silverman.
    field_bandwidth: float | str | None = None
    # Quantile of the demonstrated actions' densities above which an action counts as safe.
    field_threshold_quantile: float | None = None
    # Weight of the distance to the safe set, at most 0.
    field_alpha: float | None = None
    # What is left out of the density where it judges its own actions: episode, or nothing (the rule of before).
    field_leave_out: str | None = None
    # Action dimensions that are angles; by default those in which recorded actions jump by a period.
    field_angle_dims: tuple[int, ...] | None = None
    # Period of the angles in the dataset's units [rad; 360 for degrees].
    field_angle_period: float | None = None
    # What the field is over: actions, which must be positions, or integrated, for displacements of the end effector.
    field_over: str | None = None
    # For integrated: what an action of 1 displaces the end effector by, in units of observation.state per unit of action.
    field_displacement_scale: float | None = None
    # For integrated: dimensions of observation.state that are the end effector's position; by default the first ones.
    field_state_dims: tuple[int, ...] | None = None


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
    """Gives a trained policy a potential field without retraining: fmp becomes pf2mp, diffusion dppf, all others guarded.

    Any policy of LeRobot, or of a plug-in, that plans chunks of absolute actions is guarded: act, smolvla, pi0, pi05, vqbet,
    multi_task_dit, ... A pf2mp, dppf or guarded policy gets a new field. The new checkpoint works with lerobot-eval,
    lerobot-train and lerobot-rollout. Its weights are those of the policy; --unguard=true gives the policy back.

    --report=FOLDER writes a page about the field: whether there are enough demonstrations, which of them are alone, wrong
    values. It needs a dataset only; without --output_dir no checkpoint is written.

    Examples:
        pf2mp-fit-field --policy.path=outputs/diffusion/checkpoints/last/pretrained_model \
--dataset.repo_id=you/your_dataset --output_dir=outputs/dppf
        pf2mp-fit-field --policy.path=you/your_fmp --policy.n_field_points=10000 --dataset.repo_id=you/your_dataset \
--output_dir=outputs/pf2mp
        pf2mp-fit-field --policy.path=you/your_act --dataset.repo_id=you/your_dataset --output_dir=outputs/guarded_act
        pf2mp-fit-field --policy.path=outputs/guarded_act --unguard=true --output_dir=outputs/act
        pf2mp-fit-field --dataset.repo_id=you/your_dataset --report=reports/your_dataset
    """

    # The policy that gets a field.
    policy: FitFieldPolicyConfig = field(default_factory=FitFieldPolicyConfig)
    # The dataset of demonstrations.
    dataset: FitFieldDatasetConfig = field(default_factory=FitFieldDatasetConfig)
    # Folder of the new checkpoint.
    output_dir: Path | None = None
    # Folder of a new report: report.html, report.json and figures.
    report: Path | None = None
    # Whether to write the policy without its field instead, as it was before: pf2mp becomes fmp, dppf diffusion, and so on.
    unguard: bool = False
    # Classes of processor steps of a checkpoint that may be imported although they are not registered, by full names.
    trust: list[str] = field(default_factory=list)
    # Whether to replace an existing checkpoint and report.
    overwrite: bool = False


def main(config: FitFieldConfig) -> None:
    """Runs the command."""
    policy, dataset = config.policy, config.dataset
    path = policy.path
    if config.unguard:
        _write_unguarded(given("--policy.path", path), given("--output_dir", config.output_dir), config)
        return
    if config.report is None or config.output_dir is not None:
        path = given("--policy.path", path)
    options = {name: value for name, value in asdict(policy).items() if value is not None}
    options.pop("path", None)
    chosen: dict[str, Any] = {
        "repo_id": given("--dataset.repo_id", dataset.repo_id),
        "root": dataset.root and dataset.root.expanduser(),
        "episodes": dataset.episodes,
        "dataset_revision": dataset.revision,
        "checkpoint_revision": options.pop("revision", None),
        "options": options,
    }
    if path is None:
        of_policy = [f"--policy.{name}" for name in options if not name.startswith(("field_", "n_field_"))]
        if chosen["checkpoint_revision"] is not None:
            of_policy.append("--policy.revision")
        if of_policy:
            raise ValueError(
                f"{', '.join(of_policy)} must come with --policy.path, got a report on a dataset alone"
            )
    else:
        folder = Path(path).expanduser()
        chosen["checkpoint"] = folder if folder.is_dir() else path
    if config.report is None:
        _write_checkpoint(given("--output_dir", config.output_dir), chosen, config.overwrite)
    else:
        _write_report(config.report.expanduser(), config.output_dir, chosen, config.overwrite)


def _write_unguarded(path: str, output_dir: Path, config: FitFieldConfig) -> None:
    """Writes the policy of a guided checkpoint without its field."""
    ignored = [
        name
        for name, part in (("--policy", config.policy), ("--dataset", config.dataset))
        for key, value in asdict(part).items()
        if value is not None and key not in ("path", "revision")
    ]
    if ignored or config.report is not None:
        raise ValueError(
            "--unguard=true takes --policy.path, --policy.revision and --output_dir alone, got "
            f"{', '.join(sorted({f'{name}.*' for name in ignored}) or ['--report'])} too"
        )
    from lerobot_pf2mp.unguarding import unguard

    folder = Path(path).expanduser()
    plain = unguard(
        folder if folder.is_dir() else path,
        output_dir.expanduser(),
        revision=config.policy.revision,
        overwrite=config.overwrite,
    )
    print(f"Wrote a checkpoint of type {plain.type} to {output_dir}.")


def _write_checkpoint(output_dir: Path, chosen: dict[str, Any], overwrite: bool, **options: Any) -> None:
    from lerobot_pf2mp.fit_field import fit_field

    fitted = fit_field(output_dir=output_dir.expanduser(), overwrite=overwrite, **chosen, **options)
    print(f"Wrote a {fitted.type} checkpoint to {output_dir}.")


def _write_report(report: Path, output_dir: Path | None, chosen: dict[str, Any], overwrite: bool) -> None:
    if output_dir is not None:
        folders = [folder.expanduser().absolute() for folder in (report, output_dir)]
        if folders[0] in (folders[1], *folders[1].parents) or folders[1] in folders[0].parents:
            raise ValueError(f"--report must lie beside --output_dir, got {report} and {output_dir}")
    from lerobot_pf2mp.figures.report_page import REPORT_MARK, write_report
    from lerobot_pf2mp.fit_field import examine_dataset
    from lerobot_pf2mp.process.atomic_files import written_beside

    verdicts = []
    with written_beside(report, overwrite, kind="report", mark=REPORT_MARK, option="--report") as folder:

        def write(numbers: FieldReport) -> None:
            verdicts.append(numbers.verdict)
            write_report(numbers, folder)

        if output_dir is None:
            write(examine_dataset(**chosen))
        else:
            _write_checkpoint(output_dir, chosen, overwrite, report=write)
    print(f"{verdicts[0]}\nWrote {report / 'report.html'}.")
