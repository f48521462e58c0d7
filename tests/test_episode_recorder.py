# SPDX-License-Identifier: Apache-2.0
from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, freeze_after_episode_end

from lerobot_pf2mp import PF2MPMazeEnv
from lerobot_pf2mp.benchmark.episode_recorder import Episode, EpisodeRecorder
from lerobot_pf2mp.policies.plans.plans import Plans

NEW_ROLLOUT = {NEW_ROLLOUT_OPTION: True}


class Walk(gym.Env):
    """Steps along a list of clearances and ends at the last one; None is a step that reports nothing.

    It collides where a clearance is negative, and every step is half a metre.
    """

    observation_space = gym.spaces.Box(-1, 1, (1,))
    action_space = gym.spaces.Box(-1, 1, (1,))
    name = "walk"

    def __init__(self, clearances: Sequence[float | None], truncates: bool = False) -> None:
        self._clearances = clearances
        self._truncates = truncates

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self._step = 0
        return np.zeros(1, dtype=np.float32), self._info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self._step += 1
        at_end = self._step == len(self._clearances) - 1
        ends = at_end and not self._truncates, at_end and self._truncates
        return np.zeros(1, dtype=np.float32), 0.0, *ends, self._info()

    def _info(self) -> dict[str, Any]:
        clearance = self._clearances[self._step]
        if clearance is None:
            return {}
        so_far = [value for value in self._clearances[: self._step + 1] if value is not None]
        return {
            "clearance": clearance,
            "is_collision": min(so_far) < 0,
            "path_length": 0.5 * self._step,
        }


class Drawing(Walk):
    """A walk that reports a stroke error, which comes down and goes up again."""

    def _info(self) -> dict[str, Any]:
        return {**super()._info(), "stroke_error": abs(self._step - 2.5)}


def recorder_of(*walks: Walk, frozen: bool = True) -> EpisodeRecorder:
    """The walks side by side, as the environments of this package make them; not frozen, they begin again at their end."""
    env_fns = [partial(lambda walk: walk, walk) for walk in walks]
    return EpisodeRecorder(
        gym.vector.SyncVectorEnv(
            [freeze_after_episode_end(env_fn) if frozen else env_fn for env_fn in env_fns],
            autoreset_mode=gym.vector.AutoresetMode.NEXT_STEP,
        )
    )


def roll_out(recorder: EpisodeRecorder, n_steps: int) -> None:
    recorder.reset(options=NEW_ROLLOUT)
    for _ in range(n_steps):
        recorder.step(np.zeros((recorder.num_envs, 1), dtype=np.float32))


@pytest.mark.parametrize("frozen", [True, False])
def test_an_episode_counts_from_its_reset_to_its_last_step_and_no_further(frozen: bool) -> None:
    recorder = recorder_of(
        Walk([0.1, 0.4, 0.3]),  # closest at the reset
        Walk([0.9, 0.8, 0.7, 0.6, 0.2]),  # closest in its last step
        Walk([0.5, -0.1, 0.5], truncates=True),  # collides on the way
        Walk([0.5, 0.5, 0.5, -0.3]),  # collides in its last step
        Walk([0.7, 0.6]),
        frozen=frozen,
    )
    roll_out(recorder, 6)
    assert recorder.take_episodes(5) == [
        Episode(collision=False, min_clearance=0.1, path_length=1.0, steps=2),
        Episode(collision=False, min_clearance=0.2, path_length=2.0, steps=4),
        Episode(collision=True, min_clearance=-0.1, path_length=1.0, steps=2),
        Episode(collision=True, min_clearance=-0.3, path_length=1.5, steps=3),
        Episode(collision=False, min_clearance=0.6, path_length=0.5, steps=1),
    ]


def test_a_collision_that_is_reported_in_its_own_step_only_still_counts() -> None:
    walk = Walk([0.5, -0.1, 0.5])
    walk._info = lambda: {"is_collision": walk._clearances[walk._step] < 0}
    recorder = recorder_of(walk)
    roll_out(recorder, 2)
    assert recorder.take_episodes(1) == [Episode(True, None, None, steps=2)]


def test_a_plan_in_the_wall_counts_from_whichever_step_reports_it() -> None:
    walk, other = Walk([0.5, 0.4, 0.3]), Walk([0.5, 0.4, 0.3])
    walk._info = lambda: {"is_plan_in_wall": walk._step == 1}
    other._info = lambda: {"is_plan_in_wall": False}
    recorder = recorder_of(walk, other, Walk([None] * 3))
    roll_out(recorder, 2)
    assert [episode.plan_in_wall for episode in recorder.take_episodes(3)] == [True, False, None]


def test_what_follows_the_end_of_an_episode_does_not_count() -> None:
    # Not frozen: the first walk has ended after one step and begins again, closer to the wall at every later step.
    walk = Walk([0.7, 0.6])
    recorder = recorder_of(walk, Walk([0.5] * 6), frozen=False)
    recorder.reset(options=NEW_ROLLOUT)
    for clearance in (0.6, -0.5, -0.4, -0.3, -0.2):
        walk._clearances = [clearance, clearance]
        recorder.step(np.zeros((2, 1), dtype=np.float32))
    first, second = recorder.take_episodes(2)
    assert first == Episode(collision=False, min_clearance=0.6, path_length=0.5, steps=1)
    assert second == Episode(collision=False, min_clearance=0.5, path_length=2.5, steps=5)


def test_an_episode_that_the_rollout_ends_counts_up_to_there() -> None:
    recorder = recorder_of(Walk([0.5, 0.4, 0.3, 0.2, -0.1]))
    roll_out(recorder, 2)
    assert recorder.take_episodes(1) == [
        Episode(collision=False, min_clearance=0.3, path_length=1.0, steps=2)
    ]


def test_environments_that_report_nothing_have_steps_only() -> None:
    recorder = recorder_of(Walk([None, None, None]), Walk([None] * 4))
    roll_out(recorder, 3)
    assert recorder.take_episodes(2) == [
        Episode(None, None, None, steps=2),
        Episode(None, None, None, steps=3),
    ]


def test_only_what_is_reported_counts() -> None:
    # Gymnasium fills in zeros for those that report nothing beside others that do.
    recorder = recorder_of(Walk([None] * 4), Walk([0.4, None, 0.3, None]), Walk([0.5] * 4))
    roll_out(recorder, 3)
    assert recorder.take_episodes(3) == [
        Episode(None, None, None, steps=3),
        Episode(collision=False, min_clearance=0.3, path_length=1.0, steps=3),
        Episode(collision=False, min_clearance=0.5, path_length=1.5, steps=3),
    ]


def test_episodes_are_in_the_order_of_rollouts_and_environments_and_surplus_ones_are_dropped() -> None:
    walks = Walk([0.1] * 3), Walk([0.2] * 3)
    recorder = recorder_of(*walks)
    roll_out(recorder, 2)
    for walk, clearance in zip(walks, (0.3, 0.4), strict=True):
        walk._clearances = [clearance] * 2
    roll_out(recorder, 2)
    assert [(episode.min_clearance, episode.steps) for episode in recorder.take_episodes(3)] == [
        (0.1, 2),
        (0.2, 2),
        (0.3, 1),
    ]
    assert recorder.take_episodes(3) == []
    roll_out(recorder, 1)  # the fourth episode does not come back
    assert [episode.min_clearance for episode in recorder.take_episodes(3)] == [0.3, 0.4]


def test_a_reset_without_steps_is_no_episode() -> None:
    recorder = recorder_of(Walk([-0.9, 0.5]))
    recorder.reset()
    assert recorder.take_episodes(1) == []
    recorder.envs[0].unwrapped._clearances = [0.4, 0.5]
    roll_out(recorder, 1)
    recorder.reset()
    assert recorder.take_episodes(9) == [
        Episode(collision=False, min_clearance=0.4, path_length=0.5, steps=1)
    ]


def test_the_environment_is_passed_on_as_it_is() -> None:
    recorder = recorder_of(Walk([0.5, 0.4]), Walk([0.3, 0.2]))
    observation, info = recorder.reset(seed=[1, 2], options=NEW_ROLLOUT)
    np.testing.assert_array_equal(observation, np.zeros((2, 1)))
    np.testing.assert_array_equal(info["clearance"], [0.5, 0.3])
    _, reward, terminated, truncated, info = recorder.step(np.zeros((2, 1), dtype=np.float32))
    np.testing.assert_array_equal(reward, [0, 0])
    np.testing.assert_array_equal(terminated, [True, True])
    np.testing.assert_array_equal(truncated, [False, False])
    np.testing.assert_array_equal(info["clearance"], [0.4, 0.2])
    assert recorder.call("name") == ("walk", "walk")
    assert len(recorder.envs) == recorder.num_envs == 2
    with pytest.raises(AttributeError, match="nothing_of_this_name"):
        _ = recorder.nothing_of_this_name


@pytest.mark.slow
@pytest.mark.parametrize("control", ["exact", "pd"])
def test_the_numbers_of_a_maze_are_those_of_a_rollout_of_one_environment(control: str) -> None:
    n_envs, n_steps, seed = 3, 15, 20
    room = "11111/10001/10001/11111"
    config = PF2MPMazeEnv(maze_map=room, episode_length=n_steps, control=control, terminate_on_success=True)
    alone = gym.make("lerobot_pf2mp/MazeLarge-v0", **config.gym_kwargs)
    targets = np.random.default_rng(0).uniform(-1.4, 1.4, size=(n_steps, n_envs, 2)).astype(np.float32)
    targets[:, 0] = alone.reset(seed=seed)[0]["environment_state"]  # ends early, at its goal
    recorder = EpisodeRecorder(config.create_envs(n_envs)["pf2mp_maze"][0])
    recorder.reset(seed=[seed + i for i in range(n_envs)], options=NEW_ROLLOUT)
    for step in range(n_steps):
        recorder.step(targets[step])

    expected = []
    for i in range(n_envs):
        *_, info = alone.reset(seed=seed + i)
        clearances, collisions, ended = [info["clearance"]], [info["is_collision"]], False
        while not ended:
            _, _, terminated, truncated, info = alone.step(targets[len(clearances) - 1, i])
            clearances.append(info["clearance"])
            collisions.append(info["is_collision"])
            ended = terminated or truncated
        episode = Episode(any(collisions), min(clearances), info["path_length"], steps=len(clearances) - 1)
        expected.append(episode)
    assert recorder.take_episodes(n_envs) == expected
    assert len({episode.steps for episode in expected}) > 1


def test_the_stroke_error_is_that_at_the_end_neither_the_least_nor_the_largest() -> None:
    recorder = recorder_of(Drawing([0.5] * 5), Walk([0.5] * 5))
    roll_out(recorder, 6)
    drawn, walked = recorder.take_episodes(2)
    assert drawn.stroke_error == 1.5
    assert walked.stroke_error is None


# Plans


class Planner:
    """A policy that has made its plans already: one entry for each step, None for going on with the last one."""

    def __init__(self, *chunks: tuple[list[int], list[bool]] | None) -> None:
        self._chunks = chunks
        self.plans: Plans | None = None

    def step(self, recorder: EpisodeRecorder, number: int) -> dict[str, Any]:
        chunk = self._chunks[number]
        if chunk is not None:
            n_drawn, is_flagged = chunk
            support = torch.where(torch.tensor(is_flagged), -1.0, 1.0)
            self.plans = Plans(
                torch.tensor(n_drawn), torch.tensor(is_flagged), support, support.unsqueeze(1).expand(-1, 2)
            )
        *_, info = recorder.step(np.zeros((recorder.num_envs, 1), dtype=np.float32))
        return info

    def roll_out(self, recorder: EpisodeRecorder) -> list[dict[str, Any]]:
        recorder.reset(options=NEW_ROLLOUT)
        return [self.step(recorder, number) for number in range(len(self._chunks))]


def plans_of(episode: Episode) -> tuple[int | None, int | None, bool | None]:
    return episode.plans_drawn, episode.n_plans, episode.plan_flagged


@pytest.mark.parametrize("frozen", [True, False])
def test_plans_are_summed_over_the_chunks_of_an_episode_up_to_its_end(frozen: bool) -> None:
    recorder = recorder_of(
        Walk([0.5] * 6),  # flagged in the second chunk alone
        Walk([0.5] * 4),  # ends in the first step of the second chunk, which counts
        Walk([0.5] * 3),  # ends with the first chunk
        frozen=frozen,
    )
    planner = Planner(
        ([1, 2, 3], [False, False, False]),
        None,
        ([8, 1, 8], [True, False, True]),
        None,
        ([4, 8, 8], [False, True, True]),
    )
    recorder.watch(planner)
    planner.roll_out(recorder)
    episodes = recorder.take_episodes(3)
    assert [episode.steps for episode in episodes] == [5, 3, 2]
    assert [plans_of(episode) for episode in episodes] == [(13, 3, True), (3, 2, False), (3, 1, False)]


def test_the_info_of_every_step_says_what_was_planned_so_far() -> None:
    recorder = recorder_of(Walk([0.5] * 5), Walk([0.5] * 2))
    planner = Planner(None, ([1, 3], [False, True]), None, ([8, 8], [True, False]))
    recorder.watch(planner)
    first, *infos = planner.roll_out(recorder)
    keys = {"plans_drawn", "n_plans", "is_plan_flagged"}
    assert not keys & first.keys()  # nothing was planned yet
    found = [{key: info[key].tolist() for key in keys} for info in infos]
    began = {"plans_drawn": [1, 0], "n_plans": [1, 0], "is_plan_flagged": [False, False]}  # one has ended
    assert found == [
        began,
        began,
        {"plans_drawn": [9, 0], "n_plans": [2, 0], "is_plan_flagged": [True, False]},
    ]
    for info in infos:
        assert all(info[f"_{key}"].tolist() == [True, True] for key in keys)
    assert [info["clearance"].tolist() for info in infos] == [[0.5, 0.5]] * 3  # beside what there was


def test_the_plans_of_one_rollout_do_not_count_in_the_next() -> None:
    recorder = recorder_of(Walk([0.5] * 3))
    planner = Planner(([8], [True]), None)
    recorder.watch(planner)
    planner.roll_out(recorder)
    recorder.reset(options=NEW_ROLLOUT)  # the policy still has its last plans
    recorder.step(np.zeros((1, 1), dtype=np.float32))
    planner.roll_out(recorder)
    assert [plans_of(episode) for episode in recorder.take_episodes(3)] == [
        (8, 1, True),
        (None, None, None),
        (8, 1, True),
    ]


@pytest.mark.parametrize("policy", [object(), Planner(None, None), type("Other", (), {"plans": "many"})()])
def test_a_policy_that_says_nothing_of_its_plans_changes_nothing(policy: Any) -> None:
    recorder = recorder_of(Walk([0.5, 0.4, 0.3]))
    recorder.watch(policy)
    recorder.reset(options=NEW_ROLLOUT)
    *_, info = recorder.step(np.zeros((1, 1), dtype=np.float32))
    assert not any("plan" in key for key in info)
    recorder.step(np.zeros((1, 1), dtype=np.float32))
    assert recorder.take_episodes(1) == [
        Episode(collision=False, min_clearance=0.3, path_length=1.0, steps=2)
    ]
