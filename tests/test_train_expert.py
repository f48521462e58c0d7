# SPDX-License-Identifier: Apache-2.0
import itertools
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from safetensors.torch import load_file
from stable_baselines3.common.env_checker import check_env as check_env_of_stable_baselines3

from lerobot_pf2mp.commands import cli
from lerobot_pf2mp.dataset_tools.experts.expert_algorithms import make_algorithm
from lerobot_pf2mp.dataset_tools.experts.expert_checkpoint import ExpertCheckpoint
from lerobot_pf2mp.dataset_tools.experts.expert_settings import ExpertSettings
from lerobot_pf2mp.dataset_tools.experts.goal_env import (
    EPISODE_STEPS,
    LARGEST_STEP,
    FetchGoalEnv,
    make_goal_env,
    observation_units,
)
from lerobot_pf2mp.dataset_tools.experts.learned_expert import LearnedFetchExpert
from lerobot_pf2mp.dataset_tools.experts.train_expert import train_expert
from lerobot_pf2mp.dataset_tools.fetch.collect_fetch import collect_fetch
from lerobot_pf2mp.dataset_tools.writing.attempts import successful
from lerobot_pf2mp.envs.fetch.fetch_env import MAX_STEP, FetchEnv
from lerobot_pf2mp.process.interruption import INTERRUPTED

SMALL = {"learning_starts": 48, "batch_size": 8, "net_arch": [8], "buffer_size": 500}
SMALL_PPO = {"n_envs": 1, "n_steps": 8, "batch_size": 8, "net_arch": [8]}
FILES = (
    "expert.json",
    "steps_100/policy.safetensors",
    "steps_100/optimizers.pt",
    "steps_100/replay_buffer.npz",
)
HERE = {
    "start_range": ((1.30, 0.55, 0.50), (1.31, 0.56, 0.51)),
    "goal_range": ((1.31, 0.55, 0.50), (1.32, 0.56, 0.51)),
}  # starts are as near as 3 cm to their goals [m]


@pytest.fixture(scope="module")
def push() -> Iterator[FetchEnv]:
    env = FetchEnv("push")
    yield env
    env.close()


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("expert") / "push"
    train_expert("push", "sac_her", 100, folder, save_freq=60, options=SMALL)
    return folder


@pytest.fixture
def expert(trained: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(trained, tmp_path / "expert"))


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command in this process and returns the only line that it writes."""

    def refused(command: Callable[[], None], *arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["pf2mp", *arguments])
        capfd.readouterr()
        with pytest.raises(SystemExit, match="1"):
            command()
        captured = capfd.readouterr()
        assert captured.out == ""
        (line,) = captured.err.splitlines()
        return line

    return refused


def arrays_in(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as arrays:
        return dict(arrays)


# The environment


@pytest.mark.parametrize("task", ["reach", "push"])
@pytest.mark.filterwarnings("ignore:.*Box observation space (min|max)imum value")
def test_the_goal_environment_passes_the_checkers(task: str) -> None:
    env = FetchGoalEnv(FetchEnv(task), collision_penalty=0.5)
    check_env(env, skip_render_check=True)
    check_env_of_stable_baselines3(env)
    env.close()


@pytest.mark.parametrize("reward", ["sparse", "dense"])
def test_rewards_of_a_batch_equal_those_of_each_alone(push: FetchEnv, reward: str) -> None:
    env = FetchGoalEnv(push, reward, collision_penalty=0.5)
    rng = np.random.default_rng(0)
    achieved, desired = rng.uniform(0, 0.08, (2, 40, 3))
    infos = [{"is_touching": bool(touching)} for touching in rng.integers(0, 2, 40)]
    single = [env.compute_reward(*each) for each in zip(achieved, desired, infos, strict=True)]
    np.testing.assert_array_equal(env.compute_reward(achieved, desired, infos), single)
    distance = np.linalg.norm(achieved - desired, axis=1)
    penalty = [0.5 * info["is_touching"] for info in infos]
    expected = -distance if reward == "dense" else np.where(distance < 0.05, 0.0, -1.0)
    np.testing.assert_allclose(single, expected - penalty)
    assert len(set(np.round(single, 6))) >= 4


def test_an_action_displaces_the_gripper_by_at_most_the_largest_step(push: FetchEnv) -> None:
    env = FetchGoalEnv(push)
    env.reset(seed=0, options={"start": (1.30, 0.60, 0.60)})
    for action in ([1, 1, 1], [-1, 0, 0], [0.2, 0, 0], [0, 0, 0.5]):
        before = env.seen["agent_pos"].copy()
        observation, _, _, _, _ = env.step(np.array(action, dtype=np.float32))
        expected = LARGEST_STEP * np.array(action) / max(1.0, np.linalg.norm(action))
        np.testing.assert_allclose(env.seen["agent_pos"] - before, expected, atol=0.006)
        velocity = observation["observation"][9:12]
        np.testing.assert_allclose(velocity, (env.seen["agent_pos"] - before) / 0.04, rtol=1e-5)


def test_no_step_is_too_long_for_a_demonstration_even_where_the_gripper_turns(push: FetchEnv) -> None:
    env = FetchGoalEnv(push)
    rng = np.random.default_rng(0)
    for seed in range(3):
        env.reset(seed=seed)
        grips = [env.seen["agent_pos"]]
        for _ in range(EPISODE_STEPS):
            env.step(rng.choice([-1, 1], 3))
            grips.append(env.seen["agent_pos"])
        assert 0.9 * LARGEST_STEP < np.linalg.norm(np.diff(grips, axis=0), axis=1).max() < MAX_STEP


def test_the_observation_holds_positions_difference_and_velocities_in_sensible_units(push: FetchEnv) -> None:
    env = FetchGoalEnv(push)
    observation, _ = env.reset(seed=0, options={"start": (1.30, 0.60, 0.50), "block": (1.30, 0.90)})
    grip, block, difference, velocities = np.split(observation["observation"], [3, 6, 9])
    np.testing.assert_allclose(grip, (1.30, 0.60, 0.50), atol=0.002)
    np.testing.assert_allclose(block, (1.30, 0.90, 0.425), atol=0.002)
    np.testing.assert_array_equal(difference, block - grip)
    np.testing.assert_array_equal(velocities, np.zeros(6))
    np.testing.assert_array_equal(observation["achieved_goal"], block)
    centre, scale = observation_units(has_block=True)
    assert np.abs((observation["observation"] - centre) / scale).max() < 2.0


def test_episodes_end_after_48_steps_and_not_before() -> None:
    env = make_goal_env("reach", HERE, "dense")
    env.reset(seed=0)
    ends = [env.step(np.zeros(3, dtype=np.float32))[2:4] for _ in range(EPISODE_STEPS)]
    assert ends == [(False, False)] * 47 + [(False, True)]
    env.close()


def test_touching_the_wall_costs_the_penalty_only() -> None:
    env = FetchGoalEnv(FetchEnv("reach"), "sparse", collision_penalty=0.25)
    env.reset(seed=0, options={"start": (1.30, 0.60, 0.50), "goal": (1.30, 0.90, 0.50)})
    steps = [env.step(np.array([0.0, 1.0, 0.0], dtype=np.float32)) for _ in range(12)]
    assert {(step[1], step[4]["is_touching"]) for step in steps} == {(-1.0, False), (-1.25, True)}
    assert env.seen["agent_pos"][1] < 0.75  # it is blocked
    env.close()


# Training


@pytest.mark.slow
def test_relabelled_rewards_agree_with_the_environment_and_keep_the_penalty() -> None:
    algorithm = make_algorithm(ExpertSettings.of("reach", "sac_her", options=SMALL), "cpu")
    algorithm.learn(100)
    buffer, env = algorithm.replay_buffer, algorithm.get_env()
    np.random.seed(0)
    samples = buffer.sample(200)
    relabelled = samples.observations["desired_goal"].unique(dim=0)
    assert len(relabelled) > 10  # other goals than those of two episodes
    achieved, desired = samples.next_observations["achieved_goal"], samples.observations["desired_goal"]
    (rewards,) = env.env_method("compute_reward", achieved.numpy(), desired.numpy(), [{}] * 200)
    np.testing.assert_array_equal(samples.rewards[:, 0].numpy(), rewards)
    assert set(rewards) == {-1.0, 0.0}

    buffer._collision_penalty = 0.5
    buffer.touching[:] = True
    np.random.seed(0)
    n_real = 200 - int(200 * 0.8)
    difference = buffer.sample(200).rewards - samples.rewards
    assert difference[:, 0].tolist() == [0.0] * n_real + [-0.5] * (200 - n_real)
    env.close()


@pytest.mark.slow
def test_a_short_training_brings_the_gripper_nearer_to_the_goal(tmp_path: Path) -> None:
    env = FetchEnv("reach")

    def mean_distance(n_steps: int) -> float:
        options = {"n_envs": 1, "n_steps": 512, "batch_size": 64}
        train_expert("reach", "ppo", n_steps, tmp_path, options=options)
        demonstrate = LearnedFetchExpert(env, tmp_path, seed=1).demonstrate
        recordings = [demonstrate(number) for number in range(20)]
        return float(np.mean([np.linalg.norm(each.grips[-1] - each.goal) for each in recordings]))

    untrained, trained = mean_distance(1), mean_distance(512 * 8)
    assert trained < untrained - 0.05
    env.close()


def test_what_was_written_is_restored_exactly(trained: Path) -> None:
    checkpoint = ExpertCheckpoint.read(trained)
    assert checkpoint.n_steps == 100
    algorithm = make_algorithm(checkpoint.settings, "cpu")
    checkpoint.load_into(algorithm)
    assert algorithm.num_timesteps == 100
    buffer = algorithm.replay_buffer
    assert (buffer.pos, buffer.full) == (100, False)
    again = ExpertCheckpoint(trained.parent / "again", checkpoint.settings, 100)
    again.write(algorithm)
    weights, copy = (load_file(each.files / "policy.safetensors") for each in (checkpoint, again))
    assert "log_ent_coef" in weights
    assert any("critic_target" in name for name in weights)
    torch.testing.assert_close(copy, weights, rtol=0, atol=0)
    states = [torch.load(each.files / "optimizers.pt", weights_only=True) for each in (checkpoint, again)]
    assert set(states[0]) == {"actor.optimizer", "critic.optimizer", "ent_coef_optimizer"}
    torch.testing.assert_close(states[1], states[0], rtol=0, atol=0)
    arrays, copies = (arrays_in(each.files / "replay_buffer.npz") for each in (checkpoint, again))
    assert arrays["observations.observation"].shape == (100, 1, 15)
    assert arrays["observations.observation"].any()
    assert set(copies) == set(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(copies[name], array)
    algorithm.get_env().close()


@pytest.mark.slow
def test_training_goes_on_after_an_interruption_from_the_last_whole_checkpoint(
    expert: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = arrays_in(expert / "steps_100/replay_buffer.npz")

    def interrupted(*args: Any, **options: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(np, "savez", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train_expert("push", "sac_her", 200, expert, options=SMALL)
    assert sorted(path.name for path in expert.iterdir()) == ["expert.json", "steps_100"]
    (expert / "steps_200").mkdir()  # as a call leaves it that is killed while it writes
    assert ExpertCheckpoint.read(expert).n_steps == 100
    assert train_expert("push", "sac_her", 200, expert, options=SMALL).n_steps == 200
    assert sorted(path.name for path in expert.iterdir()) == ["expert.json", "steps_200"]
    after = arrays_in(expert / "steps_200/replay_buffer.npz")
    for name in ("actions", "observations.observation", "next_observations.achieved_goal"):
        np.testing.assert_array_equal(after[name][:100], before[name])
    assert after["actions"].shape == (200, 1, 3)
    # The episode that was under way ended at the interruption, without a terminal state to learn from.
    assert before["ep_length"][:, 0].tolist() == [48] * 96 + [0] * 4
    assert after["ep_length"][96:100, 0].tolist() == [4] * 4
    assert after["timeouts"][99, 0] == 1
    assert after["ep_start"][100, 0] == 100
    # Nothing is left to do.
    assert train_expert("push", "sac_her", 150, expert, options=SMALL).n_steps == 200


def test_the_same_seed_gives_the_same_expert_and_another_one_another(tmp_path: Path) -> None:
    weights = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        train_expert("reach", "ppo", 20, tmp_path / name, options=SMALL_PPO, seed=seed)
        weights.append(load_file(ExpertCheckpoint.read(tmp_path / name).files / "policy.safetensors"))
    assert ExpertCheckpoint.read(tmp_path / "a").n_steps == 24  # whole rollouts of 8
    torch.testing.assert_close(weights[1], weights[0], rtol=0, atol=0)
    assert not torch.equal(weights[2]["action_net.weight"], weights[0]["action_net.weight"])


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"task": "reach"}, "task"),
        ({"algo": "ppo"}, "algo"),
        ({"reward": "dense"}, "reward"),
        ({"seed": 1}, "seed"),
        ({"options": {**SMALL, "gamma": 0.9}}, "options"),
        ({"collision_penalty": 0.1}, "collision_penalty"),
        ({"scene_changes": {"wall_size": (0.16, 0.04, 0.09)}}, "scene"),
    ],
)
def test_another_expert_in_the_same_folder_is_refused(
    trained: Path, changes: dict[str, Any], name: str
) -> None:
    arguments = {"task": "push", "algo": "sac_her", "options": SMALL, **changes}
    if arguments["algo"] == "ppo":
        arguments["options"] = {}
    with pytest.raises(ValueError, match=f"holds an expert with another {name}"):
        train_expert(total_steps=200, output_dir=trained, **arguments)


def test_training_begins_anew_after_a_call_that_was_killed_before_it_named_its_first_checkpoint(
    expert: Path,
) -> None:
    (expert / "expert.json").unlink()  # it comes last, so the arrays are all there
    assert train_expert("push", "sac_her", 60, expert, options=SMALL).n_steps == 60
    assert sorted(path.name for path in expert.iterdir()) == ["expert.json", "steps_60"]


def test_a_folder_with_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(FileExistsError, match="is no expert's folder, it holds no expert.json"):
        train_expert("reach", "ppo", 8, tmp_path, options=SMALL_PPO)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    ("file", "is_missing"), [*((file, False) for file in FILES), *((file, True) for file in FILES[1:])]
)
def test_damaged_files_are_refused_in_one_line(
    expert: Path, refused: Callable[..., str], file: str, is_missing: bool
) -> None:
    path = expert / file
    half = path.read_bytes()[: path.stat().st_size // 2]
    path.unlink()
    if not is_missing:
        path.write_bytes(half)
    options = (f"--options={SMALL}", "--task=fetch_push", f"--output_dir={expert}", "--total_steps=200")
    line = refused(cli.train_expert, *options)
    assert line.startswith("error: ")
    assert str(expert) in line


def test_no_file_holds_a_pickle_that_could_run_code(trained: Path) -> None:
    paths = [path for path in trained.rglob("*") if path.is_file()]
    assert sorted(str(path.relative_to(trained)) for path in paths) == sorted(FILES)
    load_file(trained / "steps_100/policy.safetensors")
    torch.load(trained / "steps_100/optimizers.pt", weights_only=True)
    for array in arrays_in(trained / "steps_100/replay_buffer.npz").values():
        assert array.dtype != object


def test_without_stable_baselines3_one_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str]
) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    monkeypatch.delitem(sys.modules, "lerobot_pf2mp.dataset_tools.experts.expert_algorithms")
    line = refused(cli.train_expert, f"--output_dir={tmp_path / 'expert'}")
    assert line.endswith('need: pip install "lerobot_policy_pf2mp[experts]"')
    assert list(tmp_path.iterdir()) == []


# Demonstrations


def test_a_demonstration_depends_on_its_number_only(trained: Path, push: FetchEnv) -> None:
    first = LearnedFetchExpert(push, trained, seed=3)
    recordings = [first.demonstrate(number) for number in (0, 1)]
    again = LearnedFetchExpert(push, trained, seed=3).demonstrate(1)
    np.testing.assert_array_equal(again.grips, recordings[1].grips)
    np.testing.assert_array_equal(again.blocks, recordings[1].blocks)
    assert np.any(recordings[0].goal != again.goal)
    assert len(again.grips) == EPISODE_STEPS + 1 or again.is_collision


def test_an_expert_is_used_in_its_own_scene_only(trained: Path) -> None:
    for task, changes, name in (
        ("push", {"wall_size": (0.16, 0.04, 0.09)}, "wall_size"),
        ("reach", {}, "wall_size"),
    ):
        env = FetchEnv(task, **changes)
        with pytest.raises(
            ValueError, match=f"was trained for push with {name} .* must be used in the same scene"
        ):
            LearnedFetchExpert(env, trained)
        env.close()


@pytest.mark.slow
def test_collect_takes_demonstrations_from_an_experts_folder(tmp_path: Path) -> None:
    settings = ExpertSettings.of("reach", scene_changes=HERE, options=SMALL_PPO)
    algorithm = make_algorithm(settings, "cpu")
    with torch.no_grad():
        algorithm.policy.action_net.weight.zero_()  # it stays where it is
    ExpertCheckpoint(tmp_path / "expert", settings, 0).write(algorithm)
    algorithm.get_env().close()
    n_written, _ = collect_fetch(
        "reach",
        root=tmp_path / "data",
        repo_id="local/still",
        n_episodes=3,
        n_steps=48,
        style="clear",
        scene_changes=HERE,
        seed=5,
        n_processes=1,
        overwrite=False,
        expert=tmp_path / "expert",
    )
    assert n_written == 3
    card = (tmp_path / "data/README.md").read_text()
    assert "An expert trained by PPO for 0 steps (dense reward, training seed 0) moved it (seed 5)." in card


def test_collecting_from_an_expert_that_hardly_ever_succeeds_is_given_up() -> None:
    failures = itertools.repeat("without success")
    failed: Counter[str] = Counter()
    with pytest.raises(
        ValueError, match=r"at least 4 of its first 200 attempts, got 0 \(200 without success\)"
    ):
        list(successful(failures, failed))


# The commands


def test_help_shows_examples_and_units(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["pf2mp-train-expert", "--help"])
    with pytest.raises(SystemExit, match="0"):
        cli.train_expert()
    words = " ".join(capsys.readouterr().out.split())
    for fact in (
        "Examples: pf2mp-train-expert --",
        "fetch_reach or fetch_push",
        "ppo, or sac_her",
        "Environment steps of 0.04 s",
        "(default: 1000000)",
        "[m]",
    ):
        assert fact in words


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--task=maze_large"], "task must be one of ['fetch_reach', 'fetch_push'], got 'maze_large'"),
        (["--algo=td3"], "algo must be one of ['ppo', 'sac_her'], got 'td3'"),
        (["--reward=shaped"], "reward must be one of ['sparse', 'dense'], got 'shaped'"),
        (["--total_steps=0"], "total_steps must be at least 1, got 0"),
        (["--save_freq=-1"], "save_freq must be at least 1, got -1"),
        (["--seed=-1"], "seed must be at least 0, got -1"),
        (["--collision_penalty=nan"], "collision_penalty must be finite and at least 0, got nan"),
        (["--options={tau: 0.1}"], "options of ppo must be among ['n_envs', "),
        (["--options={gamma: 1.5}"], "gamma must be above 0 and at most 1, got 1.5"),
        (["--options={n_steps: few}"], "n_steps must be a whole number and at least 1, got few"),
        (["--options={net_arch: []}"], "net_arch must be a list of positive sizes, got []"),
        (
            ["--options={n_steps: 1, n_envs: 1}"],
            "batch_size must be at least 2 and divide n_envs x n_steps = 1, got 256",
        ),
        (["--device=quantum"], "device must be"),
    ],
)
def test_bad_values_end_in_one_line_and_nothing_written(
    tmp_path: Path, refused: Callable[..., str], options: list[str], message: str
) -> None:
    line = refused(cli.train_expert, f"--output_dir={tmp_path / 'expert'}", *options)
    assert line.startswith(f"error: {message}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--task=maze_umaze", "--expert=outputs"], "expert must be scripted for a maze, got 'outputs'"),
        (["--task=fetch_push", "--expert=nowhere"], "nowhere must be a folder written by pf2mp-train-expert"),
        (["--task=fetch_push", "--expert=nowhere", "--style=hug"], "style is for the scripted expert only"),
    ],
)
def test_bad_experts_for_collect_end_in_one_line_and_nothing_written(
    tmp_path: Path, refused: Callable[..., str], options: list[str], message: str
) -> None:
    assert refused(cli.collect, f"--root={tmp_path / 'd'}", *options).startswith(f"error: {message}")
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_leaves_the_last_checkpoint_and_says_so_in_one_line(
    expert: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    def interrupted(*args: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ExpertCheckpoint, "write", interrupted)
    options = (f"--options={SMALL}", "--task=fetch_push", f"--output_dir={expert}", "--total_steps=102")
    monkeypatch.setattr(sys, "argv", ["pf2mp-train-expert", *options])
    with pytest.raises(SystemExit, match=str(INTERRUPTED)):
        cli.train_expert()
    assert "Traceback" not in capsys.readouterr().err
    assert ExpertCheckpoint.read(expert).n_steps == 100
