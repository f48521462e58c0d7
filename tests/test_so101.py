# SPDX-License-Identifier: Apache-2.0
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import lerobot_pf2mp  # noqa: F401
from lerobot_pf2mp.envs.configs.so101 import PF2MPSO101Env
from lerobot_pf2mp.envs.so101.fence_scene import FenceScene, cylindrical, make_scene
from lerobot_pf2mp.errors import ConfigError

needs_so101 = pytest.mark.skipif(find_spec("so101_nexus") is None, reason="needs the extra so101")


def test_positions_are_drawn_on_both_sides_of_the_wall_within_reach() -> None:
    scene, rng = FenceScene(), np.random.default_rng(0)
    for _ in range(100):
        layout = scene.sample(rng)
        assert layout.cube[1] > 0.05 and layout.goal[1] < -0.05
        for place in (layout.cube, layout.goal):
            assert 0.16 <= cylindrical(place)[0] <= 0.30


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"wall_size": (0.2, 0.02, 0.08)}, "at most 0.06 m high"),
        ({"wall_size": (0.2, 0.0, 0.05)}, "positive"),
        ({"wall_position": (0.25, float("nan"))}, "finite numbers of shape"),
        ({"wall_position": (0.25, 0.1)}, "0.03 m away from the wall"),
        ({"cube_range": ((0.2, 0.1), (0.4, 0.1))}, "away from the arm's axis"),
        ({"goal_range": ((0.2, -0.08), (0.27, -0.16))}, "the smaller one first"),
        ({"goal_range": "here"}, "finite numbers of shape"),
    ],
)
def test_a_scene_in_which_the_arm_cannot_do_the_task_is_refused(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_scene(**changes)
    with pytest.raises(ConfigError, match=message):
        PF2MPSO101Env(**changes)


def test_the_configuration_names_what_lerobots_recorder_would() -> None:
    assert PF2MPSO101Env().features["environment_state"].shape == (5,)
    config = PF2MPSO101Env(obs_type="pixels_agent_pos", image_size=64)
    assert config.features["pixels/front"].shape == (64, 64, 3)
    assert config.features_map["pixels/front"] == "observation.images.front"
    with pytest.raises(ConfigError, match="fps must be 20"):
        PF2MPSO101Env(fps=30)
    with pytest.raises(ConfigError, match="SO101Fence-v0"):
        PF2MPSO101Env(task="SO101Gate-v0")


def test_without_the_packages_the_task_says_what_to_install() -> None:
    code = (
        "import sys; sys.modules['so101_nexus'] = None\n"
        "import gymnasium, lerobot_pf2mp\n"
        "gymnasium.make('lerobot_pf2mp/SO101Fence-v0')"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert 'pip install "lerobot_policy_pf2mp[so101]"' in result.stderr.splitlines()[-1]


@pytest.fixture(scope="module")
def env() -> Iterator[gym.Env]:
    env = gym.make("lerobot_pf2mp/SO101Fence-v0")
    yield env
    env.close()


@needs_so101
@pytest.mark.slow
class TestSimulation:
    def test_the_expert_carries_the_cube_over_the_wall_without_touching_it(self, env: gym.Env) -> None:
        from lerobot_pf2mp.dataset_tools.so101.fence_expert import ScriptedFenceExpert

        expert = ScriptedFenceExpert(env.unwrapped, "hug", seed=3)
        recordings = [expert.demonstrate(number) for number in range(3)]
        for recording in recordings:
            info = recording.info
            assert (info["is_success"], info["is_collision"], info["is_table_contact"]) == (
                True,
                False,
                False,
            )
            assert np.shape(recording.actions) == np.shape(recording.states) == (96, 6)
            # The joints follow their targets.
            assert np.abs(np.array(recording.actions)[:-1, :5] - np.array(recording.states)[1:, :5]).max() < 6
        again = expert.demonstrate(1)
        assert np.array_equal(again.actions, recordings[1].actions)
        assert np.array_equal(again.states, recordings[1].states)

    def test_a_way_through_the_wall_is_a_collision_and_costs_one_reward(self, env: gym.Env) -> None:
        _, info = env.reset(seed=0)
        assert info["clearance"] > 0 and not info["is_collision"]
        total = 0.0
        # Down beside the wall, then sideways through it.
        for pan in [-34] * 8 + list(range(-34, 40, 4)):
            _, reward, _, _, info = env.step(np.array([pan, 10, 5, 90, 0, 0], dtype=np.float32))
            total += reward
        assert info["is_collision"] and total == -1.0
        assert info["clearance"] < 0.02

    def test_the_arm_pressed_onto_the_table_is_told_apart(self, env: gym.Env) -> None:
        env.reset(seed=0)
        for _ in range(10):
            *_, info = env.step(np.array([-34, 60, 0, 60, 0, 0], dtype=np.float32))
        assert info["is_table_contact"]

    def test_the_cube_laid_onto_the_goal_is_the_success(self, env: gym.Env) -> None:
        _, info = env.reset(seed=1, options={"cube": (0.22, 0.1), "goal": (0.24, -0.1)})
        assert not info["is_success"]
        observation, _ = env.reset(seed=1, options={"cube": (0.22, 0.1), "goal": (0.24, -0.1)})
        assert np.allclose(observation["environment_state"][3:], (0.24, -0.1))
        assert np.allclose(env.unwrapped._simulation.cube[:2], (0.22, 0.1), atol=1e-3)
        with pytest.raises(ValueError, match="goal must be"):
            env.reset(options={"goal": (0.5, 0.0)})

    def test_a_cube_that_is_still_held_at_the_goal_is_no_success(self, env: gym.Env) -> None:
        from lerobot_pf2mp.dataset_tools.so101.fence_expert import ScriptedFenceExpert

        expert, simulation = ScriptedFenceExpert(env.unwrapped, "clear", seed=0), env.unwrapped._simulation
        env.reset(seed=0)
        seen = []
        for action in expert._actions(np.random.default_rng(0)):
            *_, info = env.step(action)
            offset = simulation.cube - [*simulation.layout.goal, 0.0125]
            is_there = np.hypot(*offset[:2]) < 0.03 and abs(offset[2]) < 0.01
            seen.append((is_there, bool(simulation._is_grasping()), info["is_success"]))
        assert (True, True, False) in seen
        assert (True, False, True) in seen
        assert all(success == (is_there and not held) for is_there, held, success in seen)

    def test_a_touch_in_a_single_physics_step_is_a_collision(
        self, env: gym.Env, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        env.reset(seed=0)
        wall = env.unwrapped._simulation.wall
        depths = iter([0.0, 0.0, 0.002, *[0.0] * 20])  # ten in a step
        monkeypatch.setattr(wall, "contact_depth", lambda: next(depths))
        observation, reward, _, _, info = env.step(env.unwrapped._observation()["agent_pos"])
        assert (info["is_collision"], reward, info["clearance"]) == (True, -1.0, -0.002)
        assert env.step(observation["agent_pos"])[1] == 0.0

    def test_environments_that_share_their_model_and_camera_are_apart(self) -> None:
        envs = [gym.make("lerobot_pf2mp/SO101Fence-v0", obs_type="pixels_agent_pos") for _ in range(2)]
        places = [
            {"cube": (0.20, 0.08), "goal": (0.27, -0.16)},
            {"cube": (0.27, 0.16), "goal": (0.20, -0.08)},
        ]
        for env, place in zip(envs, places, strict=True):
            env.reset(seed=0, options=place)
        first, second = (env.step(env.unwrapped._observation()["agent_pos"])[0]["pixels"] for env in envs)
        alone = gym.make("lerobot_pf2mp/SO101Fence-v0", obs_type="pixels_agent_pos")
        alone.reset(seed=0, options=places[0])
        again = alone.step(alone.unwrapped._observation()["agent_pos"])[0]["pixels"]
        assert np.array_equal(first["front"], again["front"])
        assert not np.array_equal(first["front"], second["front"])
        for env in (*envs, alone):
            env.close()

    @pytest.mark.parametrize("action", [np.zeros(5), np.full(6, np.nan)], ids=["too short", "nan"])
    def test_an_impossible_action_is_refused(self, env: gym.Env, action: np.ndarray) -> None:
        env.reset(seed=0)
        with pytest.raises(ValueError, match="six|6 finite"):
            env.step(action)

    def test_the_same_seed_gives_the_same_episode(self, env: gym.Env) -> None:
        first, _ = env.reset(seed=5)
        second, _ = env.reset(seed=5)
        other, _ = env.reset(seed=6)
        assert np.array_equal(first["environment_state"], second["environment_state"])
        assert not np.array_equal(first["environment_state"], other["environment_state"])

    def test_the_camera_sees_cube_goal_and_wall(self) -> None:
        env = gym.make(
            "lerobot_pf2mp/SO101Fence-v0",
            obs_type="pixels_agent_pos",
            render_mode="rgb_array",
            render_size=64,
        )
        observation, _ = env.reset(seed=0)
        image = observation["pixels"]["front"].astype(int)
        red, green, blue = np.moveaxis(image, -1, 0)
        assert (green > red + 60).sum() > 10  # the cube
        assert (blue > red + 60).sum() > 20  # the goal
        assert (red > green + 60).sum() > 50  # the wall
        film = env.render()
        assert film is not None
        assert film.shape == (64, 64, 3)
        env.close()

    @pytest.mark.parametrize("camera", [False, True], ids=["positions", "camera"])
    def test_demonstrations_are_what_lerobots_recorder_writes(self, tmp_path: Path, camera: bool) -> None:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        from lerobot_pf2mp.dataset_tools.so101.collect_so101 import collect_so101

        options = {"style": "clear", "seed": 0, "overwrite": False, "image_width": 64 if camera else None}
        n_written, left_out = collect_so101(
            root=tmp_path / "so101", repo_id="you/so101", n_episodes=2, n_steps=96, **options
        )
        assert (n_written, left_out.total()) == (2, 0)
        dataset = LeRobotDataset("you/so101", root=tmp_path / "so101")
        assert dataset.meta.robot_type == "sim_so_follower"
        assert dataset.fps == 20 and len(dataset) == 192
        names = dataset.meta.features["action"]["names"]
        assert names[0] == "shoulder_pan.pos" and names[-1] == "gripper.pos"
        frame = dataset[100]
        assert ("observation.images.front" in frame) is camera
        assert ("observation.environment_state" in frame) is not camera
        if camera:
            assert frame["observation.images.front"].shape == (3, 64, 64)

    def test_other_numbers_of_steps_are_refused(self, tmp_path: Path) -> None:
        from lerobot_pf2mp.dataset_tools.so101.collect_so101 import collect_so101

        options = {"style": "clear", "seed": 0, "overwrite": False}
        with pytest.raises(ValueError, match="n_steps must be 96"):
            collect_so101(root=tmp_path / "x", repo_id="you/x", n_episodes=2, n_steps=48, **options)
        with pytest.raises(ValueError, match="style must be one of"):
            collect_so101(
                root=tmp_path / "x", repo_id="you/x", n_episodes=2, n_steps=96, **{**options, "style": "fast"}
            )
