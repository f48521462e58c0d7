# SPDX-License-Identifier: Apache-2.0
import csv
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature

from lerobot_pf2mp import FMPConfig, PF2MPConfig, PF2MPMazeEnv, load_policy
from lerobot_pf2mp.benchmark import Guidance, Result, make_table, run_benchmark, write_results
from lerobot_pf2mp.policies.pf2mp.modeling_pf2mp import PF2MPPolicy
from lerobot_pf2mp.policies.pf2mp.processor_pf2mp import make_pf2mp_pre_post_processors
from lerobot_pf2mp.rate import Rate

RESULT = Result("MazeLarge-v0", "pf2mp", "proximal", 0.8, 0, 0, n_episodes=50, collisions=1, successes=49)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained policy whose field covers the middle of the maze."""
    folder = tmp_path_factory.mktemp("checkpoint")
    torch.manual_seed(0)
    config = PF2MPConfig(
        device="cpu",
        horizon=8,
        n_action_steps=8,
        down_dims=(8, 16),
        diffusion_step_embed_dim=16,
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (2,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (2,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
    )
    ends = {"min": torch.tensor([-1.5, -1.5]), "max": torch.tensor([1.5, 1.5])}
    stats = dict.fromkeys(("observation.state", "observation.environment_state", "action"), ends)
    policy = PF2MPPolicy(config, dataset_stats=stats)
    preprocessor, postprocessor = make_pf2mp_pre_post_processors(config, stats)
    batch = {
        "observation.state": torch.rand(4, 2),
        "observation.environment_state": torch.rand(4, 2),
        "action": 0.3 * torch.randn(4, 8, 2),
    }
    policy.train()
    policy(preprocessor(batch))
    for part in (policy, preprocessor, postprocessor):
        part.save_pretrained(folder)
    return folder


def test_the_wilson_interval_has_its_published_values() -> None:
    assert Rate(5, 10).interval == pytest.approx((0.2366, 0.7634), abs=1e-4)
    assert Rate(0, 10).interval == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert Rate(10, 10).interval == pytest.approx((0.7225, 1.0), abs=1e-4)
    assert str(Rate(1, 4)) == "25.0 % [4.6, 69.9]"


def test_guidance_is_read_from_text() -> None:
    assert Guidance.parse("fmp").scale == 0
    assert Guidance.parse("euler:0.0001") == Guidance("euler", 0.0001)
    for text in ("off", "proximal", "proximal:", "proximal:-1", "proximal:0", "proximal:nan", "rk4:1"):
        with pytest.raises(ValueError, match=f"got '{text}'"):
            Guidance.parse(text)


def test_all_kinds_of_guidance_see_the_same_episodes_and_every_repeat_other_noise(checkpoint: Path) -> None:
    env = PF2MPMazeEnv(task="MazeUMaze-v0", episode_length=8)
    guidances = [Guidance.parse("fmp"), Guidance.parse("proximal:0.8"), Guidance.parse("fmp")]
    options = {"n_episodes": 6, "n_repeats": 2, "seed": 7, "batch_size": 3}
    results = run_benchmark(checkpoint, env, guidances, **options)
    assert [(r.policy, r.repeat, r.n_episodes) for r in results] == [
        (policy, repeat, 6) for policy in ("fmp", "pf2mp", "fmp") for repeat in (0, 1)
    ]
    assert results[:2] == results[4:]  # the same pairs and noise, whatever ran in between
    assert run_benchmark(checkpoint, env, guidances, **options) == results


def test_every_kind_of_guidance_is_the_one_that_acts(
    checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    acted = []
    make_guide = PF2MPPolicy.make_guide

    def recorded(self: PF2MPPolicy, batch: dict) -> object:
        guide = make_guide(self, batch)
        acted.append((type(guide).__name__, getattr(guide, "scale", 0.0)))
        return guide

    monkeypatch.setattr(PF2MPPolicy, "make_guide", recorded)
    guidances = [Guidance.parse(text) for text in ("fmp", "euler:0.01", "proximal:0.8")]
    env = PF2MPMazeEnv(task="MazeUMaze-v0", episode_length=2)
    run_benchmark(checkpoint, env, guidances, n_episodes=2, n_repeats=1, seed=0)
    assert acted == [("NoneType", 0.0), ("EulerGuide", 0.01), ("ProximalGuide", 0.8)]


def test_collisions_and_successes_are_counted(checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A policy that goes straight to the goal: in a free room it arrives, through the middle wall of a U it collides.
    def to_the_goal(self: PF2MPPolicy, batch: dict, **_: object) -> torch.Tensor:
        return batch["observation.environment_state"]

    monkeypatch.setattr(PF2MPPolicy, "select_action", to_the_goal)
    options = {"n_episodes": 20, "n_repeats": 1, "seed": 0, "batch_size": 10}
    room = PF2MPMazeEnv(task="MazeUMaze-v0", episode_length=2, maze_map="11111/10001/10001/11111")
    (free,) = run_benchmark(checkpoint, room, [Guidance.parse("fmp")], **options)
    assert (free.collisions, free.successes) == (0, 20)
    (blocked,) = run_benchmark(
        checkpoint, PF2MPMazeEnv(task="MazeUMaze-v0", episode_length=2), [Guidance.parse("fmp")], **options
    )
    assert 0 < blocked.collisions < 20
    assert blocked.successes == 20


def test_the_table_shows_mean_deviation_and_interval() -> None:
    table = make_table([RESULT, replace(RESULT, repeat=1, collisions=3, successes=50)])
    row = table.splitlines()[-1]
    assert "| MazeLarge-v0 | pf2mp | proximal | 0.8 | 4.00 ± 2.83 |" in row
    assert "| 1.57 to 9.84 | 99.00 ± 1.41 | 2 x 50 |" in row


def test_results_are_written_with_versions(tmp_path: Path) -> None:
    write_results(tmp_path / "new/results.csv", [RESULT])
    with (tmp_path / "new/results.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (row["collisions"], row["lerobot"][:3]) == ("1", "0.6")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["results.csv"]


def test_loading_refuses_what_is_neither_folder_nor_repository(checkpoint: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="a checkpoint's pretrained_model folder or a repository"):
        load_policy(tmp_path / "nothing")
    policy, _, _ = load_policy(checkpoint, device="cpu", guidance_scale=0.25)
    assert policy.config.guidance_scale == 0.25
    assert not policy.training
    assert isinstance(policy.config, FMPConfig)
