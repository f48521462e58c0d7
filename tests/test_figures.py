# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, preprocess_observation
from lerobot.policies import make_pre_post_processors
from result_rows import SUMMARY, UNGUIDED
from small_benchmarks import EPISODE_SEED, UMAZE, spec_of
from untrained_policies import STATE, write_checkpoint

from lerobot_pf2mp import PF2MPConfig, PF2MPFetchEnv, PF2MPMazeEnv, load_policy
from lerobot_pf2mp import figures as plots
from lerobot_pf2mp.benchmark.run import run_benchmark
from lerobot_pf2mp.figures import Path2D, PathPair
from lerobot_pf2mp.figures.policy_figures import GuidedPolicyFigures, make_lambda_figure
from lerobot_pf2mp.policies.guided.potential_field_step import PotentialFieldProcessorStep
from lerobot_pf2mp.policies.pf2mp.modeling_pf2mp import PF2MPPolicy
from lerobot_pf2mp.results.rows import EpisodeRow, SummaryRow, read_rows, write_rows

ENV = PF2MPMazeEnv(task=UMAZE, episode_length=6)
EPISODES = [0, 1, 2]


@pytest.fixture(scope="module", params=["pf2mp", "dppf"])
def checkpoint(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_checkpoint(tmp_path_factory.mktemp("checkpoint") / request.param, request.param)


def figures_of(checkpoint: str | Path, env: Any = ENV, **options: Any) -> GuidedPolicyFigures:
    return GuidedPolicyFigures(checkpoint, env, seed=EPISODE_SEED, options=options)


def write_fetch_checkpoint(folder: Path) -> Path:
    """An untrained policy for pushing, whose field covers the middle of the table."""
    config = PF2MPConfig(
        device="cpu",
        horizon=8,
        n_action_steps=4,
        down_dims=(8, 16),
        diffusion_step_embed_dim=16,
        input_features={
            STATE: PolicyFeature(FeatureType.STATE, (3,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (6,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (3,))},
    )
    ends = {
        name: {"min": torch.full((n,), 0.4), "max": torch.full((n,), 1.2)}
        for name, n in ((STATE, 3), ("observation.environment_state", 6), ("action", 3))
    }
    preprocessor, postprocessor = make_pre_post_processors(config, dataset_stats=ends)
    (step,) = (step for step in preprocessor.steps if isinstance(step, PotentialFieldProcessorStep))
    step.demonstrations.observe(0.3 * torch.randn(4, 8, 3), None, None, settings=config.field_settings)
    for part in (PF2MPPolicy(config), preprocessor, postprocessor):
        part.save_pretrained(folder)
    return folder


def length_of(path: Path2D) -> float:
    return float(np.linalg.norm(np.diff(path.positions, axis=0), axis=1).sum())


@pytest.mark.slow
def test_the_paths_are_those_that_the_benchmark_counts(checkpoint: str, tmp_path: Path) -> None:
    figures = figures_of(checkpoint, guidance_scale=0.8)
    pairs = figures.path_pairs(1, EPISODES)
    spec = spec_of(
        {"policy": checkpoint}, "none", "proximal:0.8", n_episodes=len(EPISODES), batch_size=len(EPISODES)
    )
    run_benchmark(spec, tmp_path)
    rows = read_rows(tmp_path / "episodes.csv", EpisodeRow)
    paths = [pair.unguided for pair in pairs] + [pair.guided for pair in pairs]
    assert [bool(path.collisions.any()) for path in paths] == [row.collision for row in rows]
    assert [len(path.collisions) for path in paths] == [row.steps for row in rows]
    assert [length_of(path) for path in paths] == pytest.approx([row.path_length_m for row in rows], abs=1e-4)
    assert len({row.path_length_m for row in rows}) == len(rows)  # all of them differ
    again = figures.path_pairs(1, EPISODES)  # with the guidance as it was
    for pair, same in zip(pairs, again, strict=True):
        np.testing.assert_array_equal(pair.guided.positions, same.guided.positions)


@pytest.mark.slow
def test_named_episodes_are_drawn_in_their_order(checkpoint: str) -> None:
    pairs = figures_of(checkpoint).path_pairs(1, [2, 0])
    assert [pair.episode for pair in pairs] == [2, 0]
    for pair in pairs:
        seed = EPISODE_SEED + pair.episode
        (env,) = next(iter(ENV.create_envs(1).values())).values()
        observation, _ = env.reset(seed=[seed], options={NEW_ROLLOUT_OPTION: True})
        start = preprocess_observation(observation)
        np.testing.assert_allclose(pair.unguided.positions[0], start[STATE][0], rtol=1e-6)
        np.testing.assert_array_equal(pair.unguided.positions[0], pair.guided.positions[0])
        np.testing.assert_allclose(pair.goal, start["observation.environment_state"][0], rtol=1e-6)


def test_without_names_the_episodes_that_show_the_difference_are_drawn(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    figures = figures_of(write_checkpoint(tmp_path / "policy", "pf2mp"))

    def straight(length: float, collides: bool) -> Path2D:
        return Path2D(np.array([[0.0, 0.0], [length, 0.0]]), np.array([collides]))

    ways = {
        0.0: [(9.0, False), (1.0, True), (2.0, True), (3.0, True)],
        0.8: [(9.0, False), (1.0, False), (2.0, False), (3.0, True)],
    }
    monkeypatch.setattr("lerobot_pf2mp.figures.policy_figures._N_SEARCHED", 4)
    monkeypatch.setattr(
        figures, "_roll_out", lambda n, scale: ([straight(*way) for way in ways[scale]], [None] * n)
    )
    assert [pair.episode for pair in figures.path_pairs(3)] == [2, 1, 0]


@pytest.mark.slow
def test_the_flow_ends_with_the_chunks_that_the_policy_predicts(checkpoint: str) -> None:
    unguided, guided, starts, goals = figures_of(checkpoint).trace_flow(3)
    assert unguided.shape == guided.shape == (2 + 1, 3, 8, 2)
    torch.testing.assert_close(unguided[0], guided[0], rtol=0, atol=0)
    (env,) = next(iter(ENV.create_envs(3).values())).values()
    seeds = [EPISODE_SEED + i for i in range(3)]
    observation, _ = env.reset(seed=seeds, options={NEW_ROLLOUT_OPTION: True})
    observation = preprocess_observation(observation)
    np.testing.assert_allclose(starts, observation[STATE])
    np.testing.assert_allclose(goals, observation["observation.environment_state"])
    for scale, trace in ((0.0, unguided), (0.8, guided)):
        policy, preprocess, _ = load_policy(checkpoint, device="cpu", guidance_scale=scale, max_plans=1)
        chunk = policy.predict_action_chunk(preprocess({**observation, "task": [""] * 3}), noise=trace[0])
        # LeRobot's diffusion returns the part that is executed, which begins at the last observation.
        first = policy.config.n_obs_steps - 1 if policy.config.type == "dppf" else 0
        torch.testing.assert_close(trace[-1][:, first : first + chunk.shape[1]], chunk, rtol=0, atol=1e-6)
    assert not torch.equal(unguided[-1], guided[-1])


def test_the_scene_is_the_maze_of_the_environment_and_the_field_of_the_options(checkpoint: str) -> None:
    ring = replace(ENV, maze_map="1111/1001/1111")
    u_maze = [[1, 1, 1, 1, 1], [1, 0, 0, 0, 1], [1, 1, 1, 0, 1], [1, 0, 0, 0, 1], [1, 1, 1, 1, 1]]
    assert figures_of(checkpoint).scene().maze_map == u_maze
    assert figures_of(checkpoint, ring).scene().maze_map == [[1, 1, 1, 1], [1, 0, 0, 1], [1, 1, 1, 1]]
    scene = figures_of(checkpoint, n_field_points=5, field_bandwidth=0.25).scene()
    assert scene.field is not None
    assert (len(scene.field.anchors), scene.field.bandwidth) == (5, 0.25)
    torch.testing.assert_close(scene.to_metres(torch.ones(1, 2)), torch.full((1, 2), 1.5))


def test_an_environment_that_is_no_maze_has_no_map(checkpoint: str) -> None:
    class OtherEnv:
        task = "other"

    assert figures_of(checkpoint, OtherEnv()).scene().maze_map is None


@pytest.mark.parametrize("kind", ["fmp", "diffusion", "act"])
def test_a_policy_without_guidance_is_refused(tmp_path: Path, kind: str) -> None:
    with pytest.raises(
        ValueError, match=f"the checkpoint must be of type pf2mp, dppf or guarded, got '{kind}'"
    ):
        figures_of(write_checkpoint(tmp_path / kind, kind))


@pytest.mark.slow
@pytest.mark.parametrize("figure", ["density", "arrows", "trajectories", "overview", "flow"])
def test_every_figure_is_drawn_of_what_it_is_called(
    checkpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, figure: str
) -> None:
    calls = []
    for name in ("density", "arrows", "trajectories", "maze_overview"):
        monkeypatch.setattr(
            plots, f"plot_{name}", lambda output, _name=name, **given: calls.append((_name, given))
        )
    monkeypatch.setattr(plots, "animate_flow", lambda output, **given: calls.append(("flow", given)))
    figures_of(checkpoint).draw(figure, tmp_path / "figure", 2, [1, 2], "dark")
    ((name, given),) = calls
    assert name.endswith(figure)
    assert given["background"] == "dark"
    assert given["scene"].maze_map is not None
    if figure == "trajectories":
        assert [pair.episode for pair in given["pairs"]] == [1, 2]
    elif figure == "overview":
        assert isinstance(given["pair"], PathPair)
        assert given["pair"].episode == 1
    elif figure == "flow":
        assert given["guided"].shape[1] == len(given["starts"]) == len(given["goals"]) == 2


@pytest.mark.slow
def test_a_video_shows_every_step_of_the_episode_and_the_same_one_twice(checkpoint: str) -> None:
    figures = figures_of(checkpoint)
    pair = figures.path_pairs(1, [1])[0]
    assert pair.n_side_by_side == 2
    unguided, guided = figures.video_frames(pair)
    assert (
        (len(unguided), len(guided)) == (len(pair.unguided.positions), len(pair.guided.positions)) == (7, 7)
    )
    np.testing.assert_array_equal(unguided[0], guided[0])
    assert not np.array_equal(unguided[-1], guided[-1])
    again, _ = figures.video_frames(figures.path_pairs(1, [1])[0])
    np.testing.assert_array_equal(unguided[-1], again[-1])


@pytest.mark.slow
def test_fetch_is_drawn_with_its_wall_and_its_block_is_no_part_of_the_trajectory(tmp_path: Path) -> None:
    env = PF2MPFetchEnv(task="FetchPushWall-v0", episode_length=3)
    figures = figures_of(write_fetch_checkpoint(tmp_path / "policy"), env)
    assert [box.size for box in figures.scene().obstacles] == [(0.16, 0.04, 0.10)]
    (pair,) = figures.path_pairs(1, [0])
    assert pair.unguided.positions.shape == (4, 3)
    with pytest.raises(ValueError, match="needs a potential field over 2 action dimensions, got one over 3"):
        figures.draw("density", tmp_path / "density.png", 1, [], "light")
    figures.draw("trajectories", tmp_path / "trajectories.png", 1, [0], "light")
    figures.draw("video", tmp_path / "video.mp4", 1, [0], "light")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["policy", "trajectories.png", "video.mp4"]


@pytest.mark.slow
def test_environments_are_closed(checkpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[gym.vector.VectorEnv] = []
    create_envs = PF2MPMazeEnv.create_envs

    def recorded(self: PF2MPMazeEnv, *arguments: Any, **options: Any) -> Any:
        envs = create_envs(self, *arguments, **options)
        made.extend(next(iter(envs.values())).values())
        return envs

    monkeypatch.setattr(PF2MPMazeEnv, "create_envs", recorded)
    figures_of(checkpoint).path_pairs(1, [0])
    figures_of(checkpoint).trace_flow(1)
    assert len(made) == 3
    assert all(env.closed for env in made)


# The lambda figure


def write_summary(folder: Path, *tasks: str) -> Path:
    rows = []
    for task in tasks:
        rows += [replace(SUMMARY, task=task, **UNGUIDED), replace(SUMMARY, task=task)]
    write_rows(folder / "summary.csv", rows, SummaryRow)
    return folder


def test_the_lambda_figure_is_made_of_all_results_of_a_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: dict[str, Any] = {}
    monkeypatch.setattr(plots, "plot_lambda", lambda output, **options: given.update(options))
    first = write_summary(tmp_path / "first", "maze_a", "maze_b")
    second = write_summary(tmp_path / "second", "maze_b")
    options: dict[str, Any] = {"task": "maze_b", "background": "dark"}
    make_lambda_figure([first, second / "summary.csv"], tmp_path / "lambda.png", **options)
    assert [(cell.repeats[0].task, len(cell.repeats)) for cell in given["cells"]] == [("maze_b", 2)] * 2
    assert {cell.repeats[0].policy for cell in given["cells"]} == {SUMMARY.policy, UNGUIDED["policy"]}
    assert given["background"] == "dark"


def test_results_that_do_not_exist_are_an_error(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(FileNotFoundError):
            make_lambda_figure([path], tmp_path / "lambda.png", task=None, background="light")
