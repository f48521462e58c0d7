# SPDX-License-Identifier: Apache-2.0
"""Gives a trained policy a potential field without retraining: diffusion becomes dppf, fmp pf2mp, any other guarded."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.lerobot_types import TransitionKey
from lerobot.policies.factory import get_policy_class
from lerobot.processor import NormalizerProcessorStep
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor
from tqdm import tqdm

from lerobot_pf2mp.errors import explained
from lerobot_pf2mp.field_report.of_dataset import report_on_dataset
from lerobot_pf2mp.field_report.report import FieldReport
from lerobot_pf2mp.loading import load_config, load_processors, save_processors
from lerobot_pf2mp.policies.guarded.configuration_guarded import GuardedConfig
from lerobot_pf2mp.policies.guided.action_kind import warn_about_actions
from lerobot_pf2mp.policies.guided.action_units import normalised_unit, normaliser_of, places_of_states
from lerobot_pf2mp.policies.guided.configuration_guided import GuidedConfig
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.field_settings import INTEGRATED
from lerobot_pf2mp.policies.guided.integrated_dataset import observe_integrated_dataset
from lerobot_pf2mp.policies.guided.potential_field_step import PotentialFieldProcessorStep
from lerobot_pf2mp.policies.guided.relative_actions import refuse_relative_actions
from lerobot_pf2mp.policies.pf2mp.configuration_pf2mp import PF2MPConfig
from lerobot_pf2mp.policies.plans.demonstrated_plans import choose_plans_of_episodes
from lerobot_pf2mp.process.atomic_files import written_beside

# Policies with a guided form of their own. All others become guarded ones.
GUIDED_TYPES = {"fmp": "pf2mp", "pf2mp": "pf2mp", "diffusion": "dppf", "dppf": "dppf", "guarded": "guarded"}

_FRAMES_AT_ONCE = 65536
# What a guarded policy keeps of the options with which its base is published.
_KEPT = ("push_to_hub", "repo_id", "private", "tags", "license")


def fit_field(
    checkpoint: str | Path,
    output_dir: Path,
    *,
    repo_id: str,
    root: Path | None = None,
    episodes: Sequence[int] | None = None,
    dataset_revision: str | None = None,
    checkpoint_revision: str | None = None,
    options: dict[str, Any] | None = None,
    overwrite: bool = False,
    report: Callable[[FieldReport], None] | None = None,
) -> PreTrainedConfig:
    """Writes a new checkpoint with the same weights, guided by the field of a dataset's actions.

    The actions are normalised by the checkpoint's own preprocessor, so the field is in the space in which the policy
    generates. The anchors are those that training on all frames would have kept.

    Args:
        checkpoint: A ``pretrained_model`` folder or a repository on the Hub. A policy of a type in `GUIDED_TYPES` gets the
            type that stands there, any other one is guarded.
        output_dir: The folder to write.
        repo_id: Name of the LeRobotDataset.
        root: Its folder; None for LeRobot's cache, filled from the Hub.
        episodes: Episodes to use; None for all.
        dataset_revision: Branch, tag or commit of the dataset on the Hub.
        checkpoint_revision: Branch, tag or commit of the checkpoint on the Hub.
        options: Fields of `GuidedConfig` to change.
        overwrite: Whether a checkpoint already at `output_dir` is replaced.
        report: Gets the report on the field, before the checkpoint appears; None makes no report.

    Returns:
        The new policy's configuration.

    Raises:
        ValueError: If the checkpoint has another type, its actions are relative or have another shape than the dataset's,
            or an option breaks its rule.
        OSError: If the checkpoint or the dataset cannot be read.
        FileExistsError: If `output_dir` exists and `overwrite` is false.
    """
    config = load_config(checkpoint, revision=checkpoint_revision)
    guided = _guided_config(config, options or {})
    guided.validate_features()
    device, config.device, guided.device = guided.device, "cpu", "cpu"
    with written_beside(
        output_dir, overwrite, kind="checkpoint", mark="config.json", option="--output_dir"
    ) as new:
        with explained(f"the checkpoint {checkpoint} cannot be loaded"):
            policy_class = get_policy_class(guided.type)
            policy = policy_class.from_pretrained(checkpoint, config=guided, revision=checkpoint_revision)
            preprocessor, postprocessor = load_processors(config, checkpoint, checkpoint_revision)
        refuse_relative_actions(preprocessor.steps)
        dataset = _load_dataset(repo_id, root, episodes, dataset_revision)
        warn_about_actions(dataset, guided.field_settings)
        step = _fitted_step(guided, dataset, preprocessor.steps)
        if report is not None:
            report(report_on_dataset(step.demonstrations, dataset, partial(_normalise, preprocessor.steps)))
        preprocessor.steps = [
            *(old for old in preprocessor.steps if not isinstance(old, PotentialFieldProcessorStep)),
            step,
        ]
        guided.device = device  # only the fitting is done on the CPU
        with explained(f"the checkpoint {output_dir} cannot be written"):
            policy.save_pretrained(new)
            save_processors((preprocessor, postprocessor), new, str(device))
    return guided


def examine_dataset(
    *,
    repo_id: str,
    root: Path | None = None,
    episodes: Sequence[int] | None = None,
    dataset_revision: str | None = None,
    checkpoint: str | Path | None = None,
    checkpoint_revision: str | None = None,
    options: dict[str, Any] | None = None,
) -> FieldReport:
    """The report on the field that a policy would get from a dataset. Nothing is trained and no checkpoint is written.

    Args:
        repo_id: As for `fit_field`, like the other arguments.
        root: As there.
        episodes: As there.
        dataset_revision: As there.
        checkpoint: The policy. With None it is a pf2mp policy with its default options, whose actions are normalised by the
            dataset's own statistics.
        checkpoint_revision: As there.
        options: Fields of `GuidedConfig` to change.

    Raises:
        ValueError: As for `fit_field`, or if the dataset has no actions.
        OSError: If the checkpoint or the dataset cannot be read.
    """
    config: PreTrainedConfig
    if checkpoint is None:
        config = PF2MPConfig(device="cpu", **(options or {}))
        dataset = _load_dataset(repo_id, root, episodes, dataset_revision)
        steps = [_normaliser_for(config, dataset)]
    else:
        loaded = load_config(checkpoint, revision=checkpoint_revision, device="cpu")
        config = _guided_config(loaded, options or {})
        with explained(f"the checkpoint {checkpoint} cannot be loaded"):
            preprocessor, _ = load_processors(loaded, checkpoint, checkpoint_revision)
        steps = list(preprocessor.steps)
        refuse_relative_actions(steps)
        dataset = _load_dataset(repo_id, root, episodes, dataset_revision)
    step = _fitted_step(config, dataset, steps)
    return report_on_dataset(step.demonstrations, dataset, partial(_normalise, steps))


def _normaliser_for(config: PreTrainedConfig, dataset: LeRobotDataset) -> NormalizerProcessorStep:
    """The normaliser that training on the dataset would make; `config` gets the dataset's action."""
    shape = tuple(dataset.meta.features.get(ACTION, {}).get("shape", ()))
    if len(shape) != 1 or ACTION not in (dataset.meta.stats or {}):
        raise ValueError(
            "the dataset must have actions that are vectors, with statistics, got the features "
            f"{list(dataset.meta.features)}"
        )
    config.output_features = {ACTION: PolicyFeature(FeatureType.ACTION, shape)}
    if OBS_STATE in dataset.meta.features and OBS_STATE in dataset.meta.stats:
        of_state = tuple(dataset.meta.features[OBS_STATE]["shape"])
        config.input_features = {OBS_STATE: PolicyFeature(FeatureType.STATE, of_state)}
    return normaliser_of(config, cast(dict[str, Any], dataset.meta.stats))


def _load_dataset(
    repo_id: str, root: Path | None, episodes: Sequence[int] | None, revision: str | None
) -> LeRobotDataset:
    is_new = root is not None and not root.exists()
    try:
        with explained(f"the dataset {repo_id}{f' in {root}' if root else ''} cannot be read"):
            n_episodes = LeRobotDatasetMetadata(repo_id, root=root, revision=revision).total_episodes
            if episodes is not None and (
                not episodes or not 0 <= min(episodes) <= max(episodes) < n_episodes
            ):
                raise ValueError(f"episodes must be some of 0 to {n_episodes - 1}, got {list(episodes)}")
            return LeRobotDataset(
                repo_id,
                root=root,
                episodes=None if episodes is None else list(episodes),
                revision=revision,
                download_videos=False,
            )
    except BaseException:
        if is_new and root is not None:
            shutil.rmtree(root, ignore_errors=True)  # LeRobot may have started to download into it
        raise


def _guided_config(config: PreTrainedConfig, options: dict[str, Any]) -> PreTrainedConfig:
    if config.type not in GUIDED_TYPES:
        kept = {name: getattr(config, name) for name in _KEPT}
        return GuardedConfig(base=config, **{**kept, **options})
    guided_class = PreTrainedConfig.get_choice_class(GUIDED_TYPES[config.type])
    values = {field.name: getattr(config, field.name) for field in fields(config) if field.init}
    return guided_class(**{**values, **options})


def _fitted_step(
    config: PreTrainedConfig, dataset: LeRobotDataset, steps: Sequence[Any]
) -> PotentialFieldProcessorStep:
    """A new step for the preprocessor, with the field of the dataset's actions."""
    wanted = config.action_feature.shape
    shape = tuple(dataset.meta.features.get(ACTION, {}).get("shape", ()))
    if shape != tuple(wanted):
        raise ValueError(f"the dataset's action must have the policy's shape {tuple(wanted)}, got {shape}")
    settings = cast(GuidedConfig, config).field_settings
    step = PotentialFieldProcessorStep(**asdict(settings))
    unit, places = torch.ones(shape), torch.empty(0, 0)
    for normaliser in steps:
        if isinstance(normaliser, NormalizerProcessorStep):
            if settings.over == INTEGRATED:
                observe_integrated_dataset(
                    step.demonstrations, dataset, config, normaliser, partial(_normalise, steps)
                )
                step.demonstrations.field()
                return step
            unit, places = normalised_unit(normaliser, *shape), places_of_states(normaliser, *shape)
    frames = dataset.hf_dataset.with_format("numpy", columns=[ACTION, "index", "episode_index"])
    starts = range(0, len(frames), _FRAMES_AT_ONCE)
    for start in tqdm(starts, desc="Reading actions", unit="block", disable=len(starts) < 2):
        block = frames[start : start + _FRAMES_AT_ONCE]
        actions = torch.from_numpy(np.array(block[ACTION], dtype=np.float32)).reshape(-1, 1, *shape)
        actions = _normalise(steps, actions)
        episodes = torch.from_numpy(block["episode_index"])
        # Without a dataset_id, training that continues from this checkpoint fits a new field, to its own data.
        step.demonstrations.observe(
            actions, None, torch.from_numpy(block["index"]), episodes, settings=settings
        )
        is_start = torch.ones(1, len(episodes), dtype=torch.bool)
        is_start[0, 1:] = episodes.diff() != 0
        step.demonstrations.recognise_angles(actions.reshape(1, -1, *shape), is_start, unit)
    _observe_plans(step.demonstrations, config, dataset, steps, places)
    step.demonstrations.field()  # raises an error now if the dataset has no actions, not later at inference
    return step


def _observe_plans(
    demonstrations: DemonstratedActions,
    config: PreTrainedConfig,
    dataset: LeRobotDataset,
    steps: Sequence[Any],
    places: Tensor,
) -> None:
    """Keeps the demonstrated plans that training on all frames would have kept."""
    delta = torch.tensor(config.action_delta_indices)
    numbers = dataset.hf_dataset.with_format("numpy", columns=["index", "episode_index"])[:]
    frames, episodes = (
        torch.from_numpy(np.array(numbers[key])).reshape(-1) for key in ("index", "episode_index")
    )
    n_actions = len(delta) + int(delta[0])  # from the current step on
    n_dropped = min(getattr(config, "drop_n_last_frames", 0) or 0, n_actions - 1)
    n_dropped = max(n_dropped, cast(Any, config).n_action_steps - 1)  # as `DemonstratedActions.observe`
    chosen = choose_plans_of_episodes(episodes, frames, n_dropped)
    if not len(chosen):
        return
    # LeRobot continues a chunk beyond its episode with copies of the first or last action.
    _, number, counts = torch.unique_consecutive(episodes, return_inverse=True, return_counts=True)
    ends = counts.cumsum(0)[number[chosen]] - 1
    starts = ends + 1 - counts[number[chosen]]
    rows = (chosen.unsqueeze(1) + delta).clamp(starts.unsqueeze(1), ends.unsqueeze(1))  # (E, T)
    state = dataset.meta.features.get(OBS_STATE, {})
    has_states = bool(places.numel()) and tuple(state.get("shape", ())) == tuple(config.action_feature.shape)
    columns = [ACTION, *([OBS_STATE] if has_states else [])]
    table = dataset.hf_dataset.with_format("numpy", columns=columns)
    read = table[rows.flatten().tolist()]
    actions = torch.from_numpy(np.array(read[ACTION], dtype=np.float32)).unflatten(0, rows.shape)
    states = None
    if has_states:
        states = torch.from_numpy(np.array(table[chosen.tolist()][OBS_STATE], dtype=np.float32))
        states = _normalise(steps, states, OBS_STATE)
    demonstrations.observe_plans(
        _normalise(steps, actions)[:, -delta[0] :],
        frames[chosen],
        episodes[chosen],
        states=states,
        places=places,
        n_executed=config.n_action_steps,
    )


def _normalise(steps: Sequence[Any], values: Tensor, key: str = ACTION) -> Tensor:
    """Actions, or an observation, as the policy gets them."""
    is_action = key == ACTION
    transition: Any = (
        {TransitionKey.ACTION: values} if is_action else {TransitionKey.OBSERVATION: {key: values}}
    )
    for step in steps:
        if isinstance(step, NormalizerProcessorStep):
            transition = step(transition)
    return transition[TransitionKey.ACTION] if is_action else transition[TransitionKey.OBSERVATION][key]
