# SPDX-License-Identifier: Apache-2.0
"""Obstacles that a policy is told of: units, options, observations, the finished plan and its check."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from untrained_policies import ENV, HALF_WIDTH, STATE, write_checkpoint

from lerobot_pf2mp import PF2MPConfig
from lerobot_pf2mp.errors import ConfigError
from lerobot_pf2mp.loading import load_policy
from lerobot_pf2mp.obstacle_field import Obstacles, obstacles_of
from lerobot_pf2mp.policies.obstacles.known_obstacles import OBS_OBSTACLES
from lerobot_pf2mp.policies.obstacles.obstacle_guidance import ObstacleCheck, ObstacleGuidance
from lerobot_pf2mp.policies.obstacles.obstacle_options import ObstacleOptions
from lerobot_pf2mp.policies.obstacles.recorded_units import RecordedUnits
from lerobot_pf2mp.policies.plans.plan_choice import choose_plans
from lerobot_pf2mp.policies.plans.plans import UnsupportedPlanError

BALL = {"type": "ball", "centre": [0.0, 0.0], "radius": 0.2}
FAR = {"type": "ball", "centre": [90.0, 0.0], "radius": 0.2}


@pytest.fixture(scope="module", params=["pf2mp", "dppf", "guarded"])
def checkpoint(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_checkpoint(tmp_path_factory.mktemp("policy"), request.param)


def observed(n_robots: int = 3, **more: Tensor) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(0)
    return {key: torch.rand(n_robots, 2, generator=generator) - 0.5 for key in (STATE, ENV)} | more


def chunk_of(checkpoint: str, batch: dict[str, Any], seed: int = 0, **options: Any) -> tuple[Tensor, Any]:
    policy, preprocessor, _ = load_policy(checkpoint, device="cpu", **options)
    torch.manual_seed(seed)
    with torch.inference_mode():
        chunk = policy.predict_action_chunk(preprocessor(batch))
    return chunk, policy


def rows_of(*descriptions: dict[str, Any]) -> Tensor:
    return obstacles_of(descriptions).rows


def test_units_are_those_of_the_postprocessor(checkpoint: str) -> None:
    _, preprocessor, postprocessor = load_policy(checkpoint, device="cpu")
    (field,) = [step for step in preprocessor.steps if hasattr(step, "demonstrations")]
    assert field.demonstrations.recorded_units is None
    preprocessor(observed())
    units, recorded = field.demonstrations.recorded_units, torch.randn(5, 2)
    torch.testing.assert_close(postprocessor(units.normalised(recorded)), recorded)
    torch.testing.assert_close(units.recorded(units.normalised(recorded)), recorded)


@pytest.mark.parametrize("max_plans", [1, 4])
def test_without_an_obstacle_near_the_plan_is_the_same_bit_for_bit(checkpoint: str, max_plans: int) -> None:
    chunk, _ = chunk_of(checkpoint, observed(), max_plans=max_plans)
    for options in ({"obstacles": [FAR]}, {"obstacles": [BALL], "obstacle_rule": "ignore"}):
        assert torch.equal(chunk_of(checkpoint, observed(), max_plans=max_plans, **options)[0], chunk)
    absent = torch.zeros(3, 2, 10)
    seen = observed(**{OBS_OBSTACLES: absent})
    assert torch.equal(chunk_of(checkpoint, seen, max_plans=max_plans)[0], chunk)


def test_of_several_robots_only_those_with_an_obstacle_on_the_way_are_bent(checkpoint: str) -> None:
    plain, _ = chunk_of(checkpoint, observed(), max_plans=1)
    rows = torch.zeros(3, 2, 10)
    middle = load_policy(checkpoint, device="cpu")[2](plain[1, 1:3].mean(dim=0, keepdim=True))[0].tolist()
    rows[1:2, :1] = rows_of({**BALL, "centre": middle, "radius": 0.05})
    chunk, policy = chunk_of(
        checkpoint, observed(**{OBS_OBSTACLES: rows}), max_plans=1, on_unsupported="warn"
    )
    assert torch.equal(chunk[[0, 2]], plain[[0, 2]]) and not torch.equal(chunk[1], plain[1])
    assert bool(policy.plans.clearance[[0, 2]].isinf().all() and policy.plans.clearance[1].isfinite().all())


def test_options_and_observation_are_both_known(checkpoint: str) -> None:
    near = observed(**{OBS_OBSTACLES: rows_of(FAR).repeat(3, 1, 1)})
    plain, _ = chunk_of(checkpoint, near, max_plans=1)
    centre = (1.5 * plain[0, 1:3].mean(dim=0)).tolist()
    both, _ = chunk_of(checkpoint, near, max_plans=1, obstacles=[{**BALL, "centre": centre, "radius": 0.05}])
    assert not torch.equal(both[0], plain[0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"obstacles": [{"type": "ball"}]}, "must have centre, radius"),
        ({"obstacles": [{**BALL, "velocity": [1.0, 0.0]}]}, "must not have a velocity"),
        ({"obstacle_rule": "jump"}, "obstacle_rule must be one of"),
        ({"obstacle_margin": -1.0}, "obstacle_margin must be finite"),
        ({"robot_radius": float("nan")}, "robot_radius must be finite"),
        ({"obstacle_fps": 0.0}, "obstacle_fps must be finite and positive"),
    ],
)
def test_wrong_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        PF2MPConfig(**options)


def test_options_are_saved_and_read(tmp_path: Path) -> None:
    path = write_checkpoint(tmp_path, "pf2mp")
    policy, *_ = load_policy(path, obstacles=[BALL], robot_radius=0.1, obstacle_fps=10)
    policy.save_pretrained(tmp_path / "saved")
    saved = json.loads((tmp_path / "saved/config.json").read_text())
    assert saved["obstacles"] == [BALL] and saved["robot_radius"] == 0.1 and saved["obstacle_fps"] == 10


def test_moving_obstacles_need_the_time_of_each_action(checkpoint: str) -> None:
    moving = observed(**{OBS_OBSTACLES: rows_of({**FAR, "velocity": [0.1, 0.0]}).repeat(3, 1, 1)})
    with pytest.raises(ValueError, match="obstacle_fps"):
        chunk_of(checkpoint, moving)
    chunk_of(checkpoint, moving, obstacle_fps=10)


def test_obstacles_of_other_dimensions_are_refused(checkpoint: str) -> None:
    with pytest.raises(
        ValueError, match="as many dimensions as the positions that the field covers, 2, got 3"
    ):
        chunk_of(checkpoint, observed(), obstacles=[{**BALL, "centre": [0.0, 0.0, 0.0]}])


def test_obstacles_need_the_policys_preprocessor(checkpoint: str) -> None:
    policy, *_ = load_policy(checkpoint, device="cpu", obstacles=[BALL], guidance_scale=0.0, max_plans=1)
    with pytest.raises(ValueError, match="need the units of the recorded actions"):
        policy.predict_action_chunk(observed())


def test_a_robot_that_stands_too_near_an_obstacle_is_held_there(
    checkpoint: str, caplog: pytest.LogCaptureFixture
) -> None:
    place = torch.tensor([[0.25, 0.0]]) / HALF_WIDTH
    policy, preprocessor, _ = load_policy(
        checkpoint, device="cpu", obstacles=[BALL], robot_radius=0.1, max_plans=2, on_unsupported="hold"
    )
    batch = preprocessor(observed(1))
    policy.guidance.executed(place)
    held = policy.predict_action_chunk(dict(batch))
    torch.testing.assert_close(held, place.expand_as(held[0]).unsqueeze(0))
    assert policy.plans.clearance[0, 0] < 0 and "too near an obstacle, by up to" in caplog.text
    policy.config.on_unsupported = "stop"
    policy.guidance.executed(place)
    with pytest.raises(UnsupportedPlanError, match="too near an obstacle"):
        policy.predict_action_chunk(dict(batch))


# Without a policy.


def straight(n: int, length: int = 40) -> Tensor:
    """``(n, length, 2)`` normalised chunks along the first axis."""
    chunk = torch.zeros(n, length, 2)
    chunk[..., 0] = torch.linspace(-1, 1, length)
    return chunk


def guidance_of(obstacles: Obstacles, n: int = 1, **options: Any) -> ObstacleGuidance:
    """Normalised units are 2 m along the first axis and 0.5 m along the second."""
    units = RecordedUnits(torch.tensor([0.5, 2.0]), torch.tensor([0.1, -0.3]))
    places = units.recorded(straight(n)[:, 0])
    return ObstacleGuidance(ObstacleOptions(**options), obstacles, units, None, places, None)


def test_the_geometry_is_that_of_recorded_units() -> None:
    units = guidance_of(obstacles_of([BALL])).units
    centre = units.recorded(torch.zeros(2))
    ball = obstacles_of([{**BALL, "centre": centre.tolist()}])
    guidance = guidance_of(ball, obstacle_margin=0.1)
    assert guidance.clearances(straight(1)).min() < 0
    bent = guidance.finished(straight(1))
    distance = (units.recorded(bent) - centre).norm(dim=-1).min()
    assert 0.29 < distance < 0.35  # radius and margin, in recorded units
    assert guidance.clearances(bent).min() > 0


def test_actions_that_are_no_positions_stay() -> None:
    chunk = torch.cat([straight(1), torch.rand(1, 40, 1)], dim=-1)[..., [2, 0, 1]]
    units = RecordedUnits(torch.ones(2), torch.zeros(2))
    ball = obstacles_of([BALL])
    guidance = ObstacleGuidance(ObstacleOptions(), ball, units, (1, 2), straight(1)[:, 0], None)
    bent = guidance.finished(chunk)
    assert torch.equal(bent[..., 0], chunk[..., 0]) and not torch.equal(bent, chunk)


def test_moving_each_action_alone_leaves_a_way_that_crosses_the_obstacle() -> None:
    ball = obstacles_of([{**BALL, "centre": [-0.2, 0.15], "radius": 0.3}])
    guidance = guidance_of(ball, obstacle_margin=0.05)
    projected, bent = guidance.projected(straight(1)), guidance.finished(straight(1))
    points = guidance.units.recorded(projected)
    assert ball.distance(points, torch.zeros(1)).min() > 0.049  # every action is clear
    assert guidance.clearances(projected).min() < -0.1  # and the way is not
    assert guidance.clearances(bent).min() > 0


def test_the_first_plan_that_is_clear_is_chosen_for_each_robot() -> None:
    centre = guidance_of(obstacles_of([BALL])).units.recorded(torch.zeros(2)).tolist()
    rows = torch.cat([rows_of(FAR), rows_of({**BALL, "centre": centre})])
    guidance = guidance_of(Obstacles.from_rows(rows), 2)
    beside = straight(2) + torch.tensor([0.0, 1.5])
    asked = []

    def draw(robots: Tensor, n_each: int) -> Tensor:
        asked.append((robots.tolist(), n_each))
        return torch.stack([straight(1)[0], beside[0], straight(1)[0]])

    check = ObstacleCheck(guidance, None)
    chosen, plans = choose_plans(check, straight(2)[:, 0], straight(2), 4, draw)
    assert asked == [([1], 3)]
    assert torch.equal(chosen, torch.stack([straight(1)[0], beside[0]]))
    assert plans.is_flagged.tolist() == [False, False] and plans.n_drawn.tolist() == [1, 4]
