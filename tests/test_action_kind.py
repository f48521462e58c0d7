# SPDX-License-Identifier: Apache-2.0
"""Are the recorded actions positions? The answer, and the warning where a field is fitted to them."""

import itertools
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from forked_commands import run_well
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from lerobot.policies.factory import get_policy_class
from lerobot.processor import RelativeActionsProcessorStep
from lerobot.utils.collate import lerobot_collate_fn
from untrained_policies import MAKE_CONFIG, write_checkpoint

from lerobot_pf2mp import load_policy
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, write_dataset
from lerobot_pf2mp.fit_field import fit_field
from lerobot_pf2mp.policies.guided.action_kind import check_positions, warn_unless_positions

STATE, ACTION = "observation.state", "action"
N_EPISODES, LENGTH = 30, 60
EPISODES = np.repeat(np.arange(N_EPISODES), LENGTH)
NO_POSITIONS = "do not look like absolute positions"


def reaching(n_dims: int = 3, seed: int = 0) -> np.ndarray:
    """States (N, A) of a robot that moves smoothly between random places, three in each episode."""
    rng = np.random.default_rng(seed)
    phase = 0.5 - 0.5 * np.cos(np.pi * np.arange(LENGTH // 2) / (LENGTH // 2))
    episodes = []
    for _ in range(N_EPISODES):
        places = rng.uniform(-1, 1, (3, n_dims))
        for start, end in itertools.pairwise(places):
            episodes.append(start + phase[:, None] * (end - start))
    return np.concatenate(episodes)


def to_next(values: np.ndarray, lead: int = 1) -> np.ndarray:
    """The values `lead` frames later, and at the end of an episode the last ones."""
    rows = np.minimum(np.arange(len(values)) + lead, (EPISODES + 1) * LENGTH - 1)
    return values[rows]


def noise(values: np.ndarray, share: float) -> np.ndarray:
    return share * values.std(axis=0) * np.random.default_rng(1).normal(size=values.shape)


def with_gripper(values: np.ndarray, column: np.ndarray) -> np.ndarray:
    return np.concatenate([values, column.reshape(-1, 1)], axis=1)


STATES = reaching()
CHANGES = to_next(STATES) - STATES
IS_CLOSED = (np.arange(len(STATES)) % LENGTH > LENGTH // 2).astype(float)
GLITCH = np.where(np.arange(len(STATES)) == 70, 1e6, 0.0)[:, None]
# Actions and states.
POSITIONS = {
    "the next state": (to_next(STATES), STATES),
    "five frames ahead": (to_next(STATES, 5), STATES),
    "eight frames ahead": (to_next(STATES, 8), STATES),
    "in degrees, with an offset": (180 / np.pi * to_next(STATES) + 90, STATES),
    "with noise": (STATES + noise(STATES, 0.5), STATES + noise(STATES[::-1], 0.3)),
    "with a wrong value": (to_next(STATES) + GLITCH, STATES - GLITCH[::-1]),
    "with a constant dimension": (to_next(STATES) * [1, 0, 1], STATES),
    "with a constant dimension and a wrong value in it": (to_next(STATES) * [1, 0, 1] + GLITCH, STATES),
    "with resting joints": (
        np.concatenate([to_next(STATES), noise(reaching(5), 0.01)], axis=1),
        np.concatenate([STATES, noise(reaching(5, 2), 0.01)], axis=1),
    ),
    "with a gripper": (
        with_gripper(to_next(STATES), 2 * IS_CLOSED - 1),
        with_gripper(STATES, 0.04 - 0.03 * to_next(IS_CLOSED)),
    ),
    "at rest most of the time": (
        to_next(np.round(STATES, 0)),
        np.round(STATES, 0) + noise(STATES, 0.001),
    ),
}
OTHERS = {
    "displacements": (CHANGES, STATES),
    "displacements with noise": (CHANGES + noise(CHANGES, 1.0), STATES),
    "displacements with a wrong value": (CHANGES + GLITCH, STATES),
    "displacements beside a gripper": (with_gripper(CHANGES, IS_CLOSED), with_gripper(STATES, IS_CLOSED)),
    "displacements of a few frames": (to_next(STATES, 5) - STATES, STATES),
    "velocities": (50 * CHANGES, STATES),
    "accelerations": (to_next(CHANGES) - CHANGES, STATES),
    "noise": (noise(STATES, 1.0), STATES),
    "torques": (3 * (to_next(CHANGES) - CHANGES) + noise(CHANGES, 0.2), STATES),
}


@pytest.mark.parametrize("name", POSITIONS)
def test_positions_are_recognised(name):
    kind = check_positions(*POSITIONS[name], EPISODES)
    assert kind is not None
    assert kind.are_positions, kind


@pytest.mark.parametrize("name", OTHERS)
def test_what_is_no_position_is_recognised(name):
    kind = check_positions(*OTHERS[name], EPISODES)
    assert kind is not None
    assert not kind.are_positions, kind


def test_changes_across_the_border_of_two_episodes_do_not_count():
    kind = check_positions(CHANGES, STATES, EPISODES)
    assert kind is not None
    assert kind.with_changes > 0.99


@pytest.mark.parametrize(
    ("actions", "episodes"),
    [(np.zeros((0, 2)), np.zeros(0)), (STATES[:5], np.zeros(5)), (STATES, np.arange(len(STATES)))],
)
def test_too_few_successive_frames_tell_nothing(actions, episodes):
    assert check_positions(actions, actions, episodes) is None


def test_constant_actions_tell_nothing():
    assert check_positions(np.ones_like(STATES), STATES, EPISODES) is None


# Where a field is fitted.


def write(folder: Path, actions: np.ndarray, states: np.ndarray) -> Path:
    """A dataset of two dimensions, and with as many of another observation."""
    columns = {ACTION: actions[:, :2], STATE: states[:, :2], "observation.environment_state": states[:, :2]}
    features: dict[str, dict[str, Any]] = {
        key: {"dtype": "float32", "shape": (column.shape[1],), "names": None}
        for key, column in columns.items()
    }
    episodes = [
        {key: column[i == EPISODES].astype(np.float32) for key, column in columns.items()}
        for i in range(N_EPISODES)
    ]
    write_dataset(folder, DatasetSpec(f"local/{folder.name}", 10, features, "Do it.", "A card."), episodes)
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("action_kind")
    return {
        "positions": write(folder / "positions", to_next(STATES), STATES),
        "displacements": write(folder / "displacements", CHANGES, STATES),
        "half": write(folder / "half", np.stack([STATES[:, 0], CHANGES[:, 1]], axis=1), STATES),
        "one state": write(folder / "one_state", CHANGES, STATES[:, :1]),
    }


def warnings_in(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [message for message in caplog.messages if NO_POSITIONS in message]


def train_a_step_on(dataset: LeRobotDataset, n_steps: int = 1, **options: Any) -> Any:
    """What lerobot-train does to a policy up to its first steps."""
    config = MAKE_CONFIG["pf2mp"]()
    for name, value in options.items():
        setattr(config, name, value)
    stats = dataset.meta.stats
    policy = get_policy_class("pf2mp")(config, dataset_stats=stats, dataset_meta=dataset.meta)
    preprocessor, _ = make_pre_post_processors(config, dataset_stats=stats)
    policy.train()
    loader = torch.utils.data.DataLoader(dataset, batch_size=4, collate_fn=lerobot_collate_fn)
    for _, batch in zip(range(n_steps), loader, strict=False):
        policy(preprocessor(batch))
    return policy


def dataset_of(root: Path, **options: Any) -> LeRobotDataset:
    windows = {
        ACTION: [i / 10 for i in range(8)],
        STATE: [0.0],
        "observation.environment_state": [0.0],
    }
    return LeRobotDataset(f"local/{root.name}", root=root, delta_timestamps=windows, **options)


def test_training_warns_once_in_one_line_with_both_numbers(data, caplog):
    train_a_step_on(dataset_of(data["displacements"]), n_steps=2)
    (line,) = warnings_in(caplog)
    assert "\n" not in line
    assert "their rank correlation is 0." in line
    assert "and 1.00 with its change to the next frame" in line
    assert "Record the positions" in line


@pytest.mark.parametrize(
    ("name", "options"),
    [("positions", {}), ("half", {"field_action_dims": (0,)})],
    ids=["positions", "a field over the positions only"],
)
def test_training_does_not_warn_without_reason(name, options, data, caplog):
    train_a_step_on(dataset_of(data[name], episodes=[3, 5, 20]), **options)
    assert warnings_in(caplog) == []


def test_states_of_other_dimensions_are_not_compared(data, caplog):
    warn_unless_positions(dataset_of(data["one state"]), None)
    assert warnings_in(caplog) == []


def test_a_field_over_the_displacements_only_is_warned_of(data, caplog):
    train_a_step_on(dataset_of(data["half"]), field_action_dims=(1,))
    assert len(warnings_in(caplog)) == 1


def test_only_the_main_process_looks_and_warns(data, caplog, monkeypatch):
    monkeypatch.setattr("torch.distributed.is_initialized", lambda: True)
    monkeypatch.setattr("torch.distributed.get_world_size", lambda: 1)
    monkeypatch.setattr("torch.distributed.get_rank", lambda: 1)
    train_a_step_on(dataset_of(data["displacements"]))
    assert warnings_in(caplog) == []


@pytest.mark.slow
@pytest.mark.parametrize("command", ["lerobot-train", "pf2mp-train"])
@pytest.mark.parametrize("name", ["positions", "displacements"])
def test_the_training_commands_warn_once(command, name, data, tmp_path):
    said = run_well(
        *(command, f"--dataset.repo_id=local/{name}", f"--dataset.root={data[name]}"),
        *("--policy.type=pf2mp", "--policy.push_to_hub=false", "--policy.device=cpu", "--policy.horizon=8"),
        *("--policy.n_action_steps=8", "--policy.down_dims=[8,16]", "--policy.diffusion_step_embed_dim=16"),
        *("--batch_size=4", "--num_workers=0", "--steps=3", "--save_checkpoint=false"),
        f"--output_dir={tmp_path / 'run'}",
    )
    assert said.count(NO_POSITIONS) == (name == "displacements")


@pytest.mark.parametrize("name", ["positions", "displacements"])
def test_fitting_a_field_to_a_trained_policy_warns_too(name, data, tmp_path, caplog):
    checkpoint = write_checkpoint(tmp_path / "fmp", "fmp")
    caplog.set_level(logging.WARNING)
    fit_field(
        checkpoint, tmp_path / "new", repo_id=f"local/{data[name].name}", root=data[name], episodes=[1, 4, 7]
    )
    assert len(warnings_in(caplog)) == (name == "displacements")


# Relative actions.

RELATIVE = (
    "a potential field needs actions that are absolute positions, got a preprocessor that makes them relative"
)


def checkpoint_with_relative_step(folder: Path, kind: str, enabled: bool) -> str:
    path = write_checkpoint(folder, kind)
    _, preprocessor, _ = load_policy(path, device="cpu")
    preprocessor.steps = [*preprocessor.steps]
    preprocessor.steps.insert(2, RelativeActionsProcessorStep(enabled=enabled))
    for old in folder.glob("policy_preprocessor*"):
        old.unlink()
    preprocessor.save_pretrained(folder)
    return path


@pytest.mark.parametrize("kind", ["fmp", "pf2mp"])
def test_a_field_is_not_fitted_to_relative_actions(kind, data, tmp_path):
    checkpoint = checkpoint_with_relative_step(tmp_path / kind, kind, enabled=True)
    with pytest.raises(ValueError, match=RELATIVE):
        fit_field(checkpoint, tmp_path / "new", repo_id="local/positions", root=data["positions"])
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("guidance_scale", [0.0, 1.0])
def test_a_field_beside_relative_actions_is_not_loaded(guidance_scale, tmp_path):
    checkpoint = checkpoint_with_relative_step(tmp_path / "pf2mp", "pf2mp", enabled=True)
    with pytest.raises(ValueError, match=RELATIVE):
        load_policy(checkpoint, device="cpu", guidance_scale=guidance_scale)


def test_lerobots_own_preprocessor_refuses_a_field_beside_relative_actions(tmp_path):
    checkpoint = checkpoint_with_relative_step(tmp_path / "pf2mp", "pf2mp", enabled=True)
    preprocessor, _ = make_pre_post_processors(MAKE_CONFIG["pf2mp"](), pretrained_path=checkpoint)
    with pytest.raises(ValueError, match=RELATIVE):
        preprocessor({STATE: torch.zeros(2)})


def test_a_relative_step_that_is_off_changes_nothing(tmp_path):
    checkpoint = checkpoint_with_relative_step(tmp_path / "pf2mp", "pf2mp", enabled=False)
    _, preprocessor, _ = load_policy(checkpoint, device="cpu")
    assert torch.equal(preprocessor({STATE: torch.zeros(2)})[STATE], torch.zeros(1, 2))


def test_a_policy_without_a_field_may_have_relative_actions(tmp_path):
    checkpoint = checkpoint_with_relative_step(tmp_path / "fmp", "fmp", enabled=True)
    assert load_policy(checkpoint, device="cpu")
