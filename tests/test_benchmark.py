# SPDX-License-Identifier: Apache-2.0
import json
import math
import re
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_benchmarks import (
    EPISODE_LENGTH,
    EPISODE_SEED,
    N_EPISODES,
    UMAZE,
    outcomes,
    rows_of,
    run,
    spec_of,
    timeless,
)
from torch import Tensor
from untrained_policies import ENV, HALF_WIDTH, MAKE_CONFIG, STATE, write_checkpoint

from lerobot_pf2mp import FMPConfig, PF2MPMazeEnv, load_policy
from lerobot_pf2mp.benchmark import evaluation
from lerobot_pf2mp.benchmark.run import run_benchmark
from lerobot_pf2mp.benchmark.spec import NONE, BenchmarkSpec, Guidance
from lerobot_pf2mp.envs.maze.maze_env import MazeEnv
from lerobot_pf2mp.errors import ConfigError
from lerobot_pf2mp.loading import loaded_demonstrations
from lerobot_pf2mp.policies.fmp import modeling_fmp
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.field_guidance import FieldGuidance
from lerobot_pf2mp.policies.guided.potential_field_step import PotentialFieldProcessorStep
from lerobot_pf2mp.policies.pf2mp.modeling_pf2mp import PF2MPPolicy
from lerobot_pf2mp.policies.plans.plans import Plans
from lerobot_pf2mp.results.rows import SummaryRow, read_rows

COLUMNS = (
    "task,policy,guidance_integrator,guidance_scale,variant,seed,repeat,episode,success,collision,plan_in_wall,min_clearance_m,"
    "path_length_m,stroke_error_mm,steps,chunk_latency_ms,checkpoint,commit,plans_drawn,n_plans,plan_flagged,obstacle_collision"
)


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """One checkpoint of each kind of policy."""
    folder = tmp_path_factory.mktemp("checkpoints")
    return {kind: write_checkpoint(folder / kind, kind) for kind in MAKE_CONFIG}


@pytest.fixture(autouse=True, scope="module")
def _mazes_are_made_once() -> Iterator[None]:
    """A maze takes half a second to make; here all benchmarks with the same options share theirs."""
    create_envs, made = PF2MPMazeEnv.create_envs, {}

    def create_once(self: PF2MPMazeEnv, n_envs: int, use_async_envs: bool = False) -> Any:
        key = repr(self), n_envs
        if key not in made:
            made[key] = create_envs(self, n_envs, use_async_envs)
        return made[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PF2MPMazeEnv, "create_envs", create_once)
        yield


@pytest.fixture(scope="module")
def whole_spec(checkpoints: dict[str, str]) -> BenchmarkSpec:
    """Three kinds of guidance in two repeats each."""
    return spec_of({"pf2mp": checkpoints["pf2mp"]}, "none", "euler:0.01", "proximal:0.8", n_repeats=2)


@pytest.fixture(scope="module")
def whole(
    whole_spec: BenchmarkSpec, tmp_path_factory: pytest.TempPathFactory, _mazes_are_made_once: None
) -> Path:
    """The folder of `whole_spec`, run without interruption."""
    folder = tmp_path_factory.mktemp("whole") / "benchmark"
    run_benchmark(whole_spec, folder)
    return folder


@pytest.fixture
def copied(whole: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole, tmp_path / "benchmark")


@pytest.fixture
def evaluations(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The guidance scales of the evaluations that really run."""
    scales: list[float] = []
    eval_policy = evaluation.eval_policy

    def counted(env: Any, policy: Any, *arguments: Any, **options: Any) -> Any:
        scales.append(getattr(policy.config, "guidance_scale", 0.0))
        return eval_policy(env, policy, *arguments, **options)

    monkeypatch.setattr(evaluation, "eval_policy", counted)
    return scales


# What to compare


def test_guidance_is_read_from_text() -> None:
    assert Guidance.parse("none") == [NONE]
    assert Guidance("none", 0.0) == NONE
    assert Guidance.parse("euler:0.0001") == [Guidance("euler", 0.0001)]
    assert Guidance.parse("proximal:0.08,0.8,8") == [Guidance("proximal", scale) for scale in (0.08, 0.8, 8)]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "off",
        "fmp",
        "None",
        "none:1",
        "proximal",
        "proximal:",
        "proximal:weak",
        "proximal:0.8,",
        "proximal:0.8;8",
    ]
    + [f"proximal:{scale}" for scale in ("0", "-1", "nan", "inf", "0.8,0")]
    + ["rk4:1", ":1", "Euler:1"],
)
def test_text_that_is_no_guidance_is_refused_with_the_rule(text: str) -> None:
    rule = "guidance must be none or INTEGRATOR:SCALE,SCALE,... with an integrator of ('euler', 'proximal') and positive"
    with pytest.raises(ValueError, match=f"{re.escape(rule)} scales, got '{re.escape(text)}'"):
        Guidance.parse(text)


@pytest.mark.parametrize("name", ["n_repeats", "n_episodes", "batch_size"])
def test_numbers_below_one_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
        spec_of({"pf2mp": "somewhere"}, **{name: 0})


@pytest.mark.parametrize(
    ("name", "empty"), [("tasks", ()), ("policies", {}), ("guidances", ()), ("variants", {}), ("seeds", ())]
)
def test_nothing_to_compare_is_refused(name: str, empty: Any) -> None:
    with pytest.raises(ValueError, match=f"{name} must name at least one, got none"):
        replace(spec_of({"pf2mp": "somewhere"}), **{name: empty})


@pytest.mark.parametrize(
    ("name", "values"), [("tasks", (UMAZE, UMAZE)), ("guidances", (NONE, NONE)), ("seeds", (3, 4, 3))]
)
def test_what_is_named_twice_is_refused(name: str, values: tuple) -> None:
    with pytest.raises(ValueError, match=f"{name} must differ from each other, got "):
        replace(spec_of({"pf2mp": "somewhere_{seed}"}), **{name: values})


def test_several_training_seeds_of_one_checkpoint_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"the path of 'act' must hold \{seed\}, got somewhere and the seeds"
    ):
        spec_of({"pf2mp": "somewhere_{seed}", "act": "somewhere"}, seeds=(0, 1))


@pytest.mark.parametrize("option", ["guidance_scale", "guidance_integrator"])
def test_guidance_is_not_changed_by_a_variant(option: str) -> None:
    with pytest.raises(
        ValueError, match=f"{option} must be given as guidance, got it in the variant 'strong'"
    ):
        spec_of({"pf2mp": "somewhere"}, variants={"": {}, "strong": {option: 8.0}})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 1}, r"a pf2mp policy's option must be one of \[.*'num_inference_steps'.*\], got 'steps'"),
        ({"num_inference_steps": 0}, "num_inference_steps must be at least 1, got 0"),
        ({"num_inference_steps": "many"}, "`num_inference_steps`: Couldn't parse 'many' into an int"),
    ],
)
def test_an_option_that_cannot_be_is_an_error_before_anything_is_written(
    checkpoints: dict[str, str], tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    spec = spec_of({"pf2mp": checkpoints["pf2mp"]}, variants={"": {}, "other": options})
    with pytest.raises(ValueError, match=message):
        run_benchmark(spec, tmp_path / "benchmark")
    assert not list(tmp_path.iterdir())


def test_less_than_one_process_is_refused(checkpoints: dict[str, str], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="n_processes must be at least 1, got 0"):
        run_benchmark(spec_of(checkpoints), tmp_path / "benchmark", n_processes=0)
    assert not list(tmp_path.iterdir())


def test_a_checkpoint_that_does_not_exist_is_an_error_before_anything_is_written(
    checkpoints: dict[str, str], tmp_path: Path
) -> None:
    spec = spec_of({"pf2mp": checkpoints["pf2mp"], "other": "/no/where/{task}_{seed}"}, seeds=(3,))
    with pytest.raises(FileNotFoundError, match=f"pretrained_model folder .* got /no/where/{UMAZE}_3"):
        run_benchmark(spec, tmp_path / "benchmark")
    assert not list(tmp_path.iterdir())


def test_two_policies_whose_rows_have_one_name_are_an_error_before_anything_is_written(
    checkpoints: dict[str, str], tmp_path: Path
) -> None:
    both = {name: checkpoints[name] for name in ("pf2mp", "fmp")}
    with pytest.raises(
        ValueError, match=r"every policy must have its own name, got 'fmp' twice \(guidance none\)"
    ):
        run_benchmark(spec_of(both, "none"), tmp_path / "benchmark")
    assert not list(tmp_path.iterdir())


def test_a_task_that_does_not_exist_is_an_error_before_anything_is_written(
    checkpoints: dict[str, str], tmp_path: Path
) -> None:
    spec = spec_of({"pf2mp": checkpoints["pf2mp"]}, tasks=(UMAZE, "MazeHuge-v0"))
    with pytest.raises(ConfigError, match="task must be one of .* got 'MazeHuge-v0'"):
        run_benchmark(spec, tmp_path / "benchmark")
    assert not list(tmp_path.iterdir())


# Rows


def test_every_episode_is_one_row(whole: Path, whole_spec: BenchmarkSpec) -> None:
    assert (whole / "episodes.csv").read_text().splitlines()[0] == COLUMNS
    rows = rows_of(whole)
    assert [
        (row.policy, row.guidance_integrator, row.guidance_scale, row.repeat, row.episode) for row in rows
    ] == [
        (*policy, repeat, episode)
        for policy in (("fmp", "none", 0.0), ("pf2mp", "euler", 0.01), ("pf2mp", "proximal", 0.8))
        for repeat in (0, 1)
        for episode in range(N_EPISODES)
    ]
    for row in rows:
        assert (row.task, row.variant, row.seed) == (UMAZE, "", 0)
        assert row.steps == EPISODE_LENGTH
        assert row.collision == (row.min_clearance_m < 0)
        assert row.path_length_m > 0
        assert row.checkpoint == whole_spec.policies["pf2mp"]
        assert re.fullmatch("([0-9a-f]{10})?", row.commit)
    for start in range(0, len(rows), N_EPISODES):
        (latency,) = {row.chunk_latency_ms for row in rows[start : start + N_EPISODES]}
        assert latency > 0


def test_a_benchmark_leaves_rows_summary_tables_and_what_it_was_made_with(
    whole: Path, whole_spec: BenchmarkSpec, copied: Path
) -> None:
    assert {path.name for path in whole.iterdir()} == {
        "episodes.csv",
        "summary.csv",
        "table.md",
        "table.tex",
        "run.json",
    }
    assert run_benchmark(whole_spec, copied) == read_rows(whole / "summary.csv", SummaryRow)
    assert [line.split("|")[2].strip() for line in (whole / "table.md").read_text().splitlines()[2:]] == [
        "fmp",
        "pf2mp",
        "pf2mp",
    ]
    assert (whole / "table.tex").read_text().count(r"\\") == 1 + 3
    run_json = json.loads((whole / "run.json").read_text())
    assert run_json["episodes"]["env"]["episode_length"] == EPISODE_LENGTH
    assert run_json["episodes"]["episode_seed"] == EPISODE_SEED
    assert run_json["variants"] == {"": {}}
    assert run_json["made_with"]["lerobot"].startswith("0.6.")
    assert run_json["made_with"].keys() == {
        *("lerobot", "torch", "mujoco", "gymnasium-robotics", "diffusers", "python", "machine")
    }


@pytest.mark.slow
def test_a_guided_policy_has_another_name_without_guidance_and_others_are_evaluated_once(
    checkpoints: dict[str, str], tmp_path: Path
) -> None:
    policies = {
        "pf2mp": checkpoints["pf2mp"],
        "dppf": checkpoints["dppf"],
        "mine": checkpoints["pf2mp"],
        "flow": checkpoints["fmp"],
        "diffusion": checkpoints["diffusion"],
        "act": checkpoints["act"],
    }
    spec = spec_of(policies, "none", "proximal:0.8", n_repeats=2, n_episodes=2)
    assert Counter(
        (row.policy, row.guidance_integrator, row.guidance_scale, row.checkpoint)
        for row in run(spec, tmp_path)
    ) == {
        (name, *guidance, checkpoints[kind]): 2 * 2
        for name, guidance, kind in (
            ("fmp", ("none", 0.0), "pf2mp"),
            ("pf2mp", ("proximal", 0.8), "pf2mp"),
            ("dp", ("none", 0.0), "dppf"),
            ("dppf", ("proximal", 0.8), "dppf"),
            ("mine unguided", ("none", 0.0), "pf2mp"),
            ("mine", ("proximal", 0.8), "pf2mp"),
            ("flow", ("none", 0.0), "fmp"),
            ("diffusion", ("none", 0.0), "diffusion"),
            ("act", ("none", 0.0), "act"),
        )
    }


def test_policies_without_guidance_are_evaluated_whatever_guidance_is_asked_for(
    checkpoints: dict[str, str], tmp_path: Path
) -> None:
    rows = run(
        spec_of({name: checkpoints[name] for name in ("act", "pf2mp")}, "proximal:0.8", "proximal:8"),
        tmp_path,
    )
    assert Counter((row.policy, row.guidance_scale) for row in rows) == {
        ("act", 0.0): N_EPISODES,
        ("pf2mp", 0.8): N_EPISODES,
        ("pf2mp", 8.0): N_EPISODES,
    }


def test_names_may_hold_commas_and_quotes(checkpoints: dict[str, str], tmp_path: Path) -> None:
    name, variant = 'mine, the "new" one', "N=1, few"
    spec = spec_of({name: checkpoints["fmp"]}, variants={variant: {"num_inference_steps": 1}})
    rows = run(spec, tmp_path)
    assert [(row.policy, row.variant, row.episode) for row in rows] == [
        (name, variant, i) for i in range(N_EPISODES)
    ]
    assert run(spec, tmp_path) == rows


@pytest.mark.slow
def test_task_and_seed_in_a_path_stand_for_the_task_and_the_training_seed(
    checkpoints: dict[str, str], tmp_path: Path
) -> None:
    tasks, seeds = (UMAZE, "MazeMedium-v0"), (3, 11)
    for task in tasks:
        for seed in seeds:
            write_checkpoint(tmp_path / task / f"seed_{seed}", "fmp", seed)
    spec = spec_of({"flow": f"{tmp_path}/{{task}}/seed_{{seed}}"}, tasks=tasks, seeds=seeds, n_episodes=2)
    rows = run(spec, tmp_path / "benchmark")
    assert [(row.task, row.seed, row.checkpoint) for row in rows] == [
        (task, seed, f"{tmp_path}/{task}/seed_{seed}") for task in tasks for seed in seeds for _ in range(2)
    ]
    # All four differ in maze or weights, and so in their trajectories.
    assert len({row.path_length_m for row in rows}) == len(rows)


@pytest.mark.slow
def test_variants_change_the_configuration_of_the_policy(
    checkpoints: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded = []
    load = evaluation.load_policy

    def recorded(*arguments: Any, **options: Any) -> Any:
        policy, *processors = load(*arguments, **options)
        config = policy.config
        loaded.append((config.num_inference_steps, config.n_field_points, config.field_bandwidth))
        return policy, *processors

    monkeypatch.setattr(evaluation, "load_policy", recorded)
    variants = {
        "": {},
        "one step": {"num_inference_steps": 1},
        "few": {"n_field_points": 5, "field_bandwidth": 0.25},
    }
    rows = run(spec_of({"pf2mp": checkpoints["pf2mp"]}, "none", "proximal:0.8", variants=variants), tmp_path)
    assert loaded == [(2, 20000, "likelihood"), (1, 20000, "likelihood"), (2, 5, 0.25)]

    unguided = [outcomes(rows, "fmp", variant=variant) for variant in variants]
    guided = [outcomes(rows, "pf2mp", variant=variant) for variant in variants]
    assert unguided[0] == unguided[2]  # without guidance the field does nothing
    paths = [episode[-1] for episodes in (*unguided[:2], *guided) for episode in episodes]
    assert len(set(paths)) == len(paths) == 5 * N_EPISODES


@pytest.mark.parametrize(
    "options",
    [
        {"use_ema": False},
        {"guidance_point": None},
        {"guidance_point": "current"},
        {"field_bandwidth": 0.1},
        {"field_bandwidth": "scott"},
        {"field_action_dims": (0, 1), "guidance_scale": 0},  # the field covers all, which cannot be changed
    ],
    ids=str,
)
def test_options_of_every_type_can_be_changed(checkpoints: dict[str, str], options: dict[str, Any]) -> None:
    policy, _, _ = load_policy(checkpoints["pf2mp"], device="cpu", **options)
    assert {name: getattr(policy.config, name) for name in options} == options


@pytest.mark.parametrize("kind", ["pf2mp", "dppf"])
def test_every_kind_of_guidance_is_the_one_that_acts(
    checkpoints: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
) -> None:
    acted: list[tuple[str, float]] = []
    make_guide = FieldGuidance.guide

    def recorded(self: Any, batch: dict, device: torch.device) -> Any:
        guide = make_guide(self, batch, device)
        kind_of_guide = type(guide).__name__, getattr(guide, "scale", 0.0)
        if kind_of_guide not in acted[-1:]:
            acted.append(kind_of_guide)
        return guide

    monkeypatch.setattr(FieldGuidance, "guide", recorded)
    guidances = ("euler:0.01", "none", "proximal:0.8,0.08", "euler:0.02")
    run(spec_of({kind: checkpoints[kind]}, *guidances), tmp_path)
    assert acted == [
        ("EulerGuide", 0.01),
        ("NoneType", 0.0),
        ("ProximalGuide", 0.8),
        ("ProximalGuide", 0.08),
        ("EulerGuide", 0.02),
    ]


@pytest.mark.slow
def test_collisions_and_successes_are_counted(
    checkpoints: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A policy that goes straight to the goal: in a free room it arrives, through the middle wall of a U it collides.
    target = ENV

    def straight(self: PF2MPPolicy, batch: dict, **_: object) -> Tensor:
        return batch[target]

    monkeypatch.setattr(PF2MPPolicy, "select_action", straight)
    policies, options = {"pf2mp": checkpoints["pf2mp"]}, {"n_episodes": 12, "batch_size": 4}
    env = PF2MPMazeEnv(task=UMAZE, episode_length=2, maze_map="11111/10001/10001/11111")
    room = run(spec_of(policies, env=env, **options), tmp_path / "room")
    assert [(row.collision, row.success, row.steps) for row in room] == [(False, True, 2)] * 12
    maze = MazeEnv(env.maze_map)
    for row in room:
        observation, _ = maze.reset(seed=EPISODE_SEED + row.episode)
        way = observation["environment_state"] - observation["agent_pos"]
        assert row.path_length_m == pytest.approx(math.hypot(*way), abs=1e-5)
        assert 0 < row.min_clearance_m < 0.75

    u = run(spec_of(policies, env=replace(env, maze_map=None), **options), tmp_path / "u")
    assert all(row.success for row in u)
    assert 0 < sum(row.collision for row in u) < 12
    assert all(row.collision == (row.min_clearance_m < 0) for row in u)

    target = STATE  # and one that stays where it is
    still = run(spec_of(policies, env=env, **options), tmp_path / "still")
    assert [(row.collision, row.success) for row in still] == [(False, False)] * 12
    assert all(row.path_length_m == pytest.approx(0, abs=1e-5) for row in still)


@pytest.mark.slow
def test_the_latency_is_that_of_planning_a_chunk_for_one_robot(
    checkpoints: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    predict, at_least = PF2MPPolicy.predict_action_chunk, 0.05

    def slow_for_one_robot(self: PF2MPPolicy, batch: dict, **options: Any) -> Tensor:
        if len(batch[STATE]) == 1:
            time.sleep(at_least)
        return predict(self, batch, **options)

    monkeypatch.setattr(PF2MPPolicy, "predict_action_chunk", slow_for_one_robot)
    run_benchmark(spec_of({"pf2mp": checkpoints["pf2mp"]}), tmp_path)
    assert all(1000 * at_least <= row.chunk_latency_ms < 2000 for row in rows_of(tmp_path))


# Plans

N_CHUNKS = 2  # of four actions, in six steps


@pytest.fixture
def checked(monkeypatch: pytest.MonkeyPatch) -> list[Plans | None]:
    """The plans of every chunk that is not for the measurement of the latency."""
    seen: list[Plans | None] = []
    choose = FieldGuidance.choose

    def recorded(self: Any, batch: dict, chunk: Tensor, *arguments: Any) -> Tensor:
        chosen = choose(self, batch, chunk, *arguments)
        if len(chunk) > 1:
            seen.append(self.plans)
        return chosen

    monkeypatch.setattr(FieldGuidance, "choose", recorded)
    return seen


@pytest.mark.parametrize("kind", ["pf2mp", "dppf"])
def test_rows_count_the_plans_that_the_policy_drew_and_flagged(
    checkpoints: dict[str, str], tmp_path: Path, checked: list[Plans], kind: str
) -> None:
    # A rate at which the untrained policy is flagged now and then.
    variants = {"": {"max_plans": 2, "false_alarm_rate": 0.9}}
    rows = run(spec_of({kind: checkpoints[kind]}, "proximal:0.8", n_repeats=2, variants=variants), tmp_path)
    assert len(checked) == 2 * 2 * N_CHUNKS  # repeats, rollouts of two robots
    drawn = torch.stack([plans.n_drawn for plans in checked]).view(2, 2, N_CHUNKS, 2).sum(dim=2).flatten(1)
    flagged = (
        torch.stack([plans.is_flagged for plans in checked]).view(2, 2, N_CHUNKS, 2).any(dim=2).flatten(1)
    )
    assert len(drawn.unique()) > 1, "one number for all would hide a sum over other chunks or robots"
    assert [(row.plans_drawn, row.n_plans, row.plan_flagged) for row in rows] == [
        (drawn[repeat, episode].item(), N_CHUNKS, flagged[repeat, episode].item())
        for repeat in (0, 1)
        for episode in range(N_EPISODES)  # the fourth is one too many
    ]
    (summary, _) = read_rows(tmp_path / "summary.csv", SummaryRow)
    assert (summary.plans_drawn, summary.n_plans) == (drawn[0, :N_EPISODES].sum(), N_EPISODES * N_CHUNKS)
    assert summary.flagged == flagged[0, :N_EPISODES].sum()
    assert " | plans | flagged [%] | " in (tmp_path / "table.md").read_text()


def test_without_guidance_a_plan_is_checked_and_no_other_one_drawn_unless_the_variant_says_so(
    checkpoints: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: list[tuple[int, bool]] = []
    choose = FieldGuidance.choose

    def recorded(self: Any, *arguments: Any) -> Tensor:
        if (now := (self.config.max_plans, self.measures_plans)) not in used[-1:]:
            used.append(now)
        return choose(self, *arguments)

    monkeypatch.setattr(FieldGuidance, "choose", recorded)
    variants = {"": {}, "three": {"max_plans": 3}, "one": {"max_plans": 1}}
    guidances = ("none", "proximal:0.8", "euler:0.01")
    rows = run(spec_of({"pf2mp": checkpoints["pf2mp"]}, *guidances, variants=variants), tmp_path)
    # First the latency, without a check that only the benchmark asks for.
    own = [(1, False), (1, True), *[(8, False), (8, True)] * 2]
    assert used == own + [(3, False), (3, True)] * 3 + [(1, False), (1, True)] * 3
    for row in rows:
        most = {"": 8 if row.guidance_scale else 1, "three": 3, "one": 1}[row.variant]
        assert row.n_plans == N_CHUNKS and row.plan_flagged is not None
        assert N_CHUNKS <= row.plans_drawn <= N_CHUNKS * most
    assert {row.plans_drawn for row in rows if row.variant == "" and not row.guidance_scale} == {N_CHUNKS}
    assert max(row.plans_drawn for row in rows if row.variant == "") > 3 * N_CHUNKS


def test_measuring_plans_changes_no_episode(
    checkpoints: dict[str, str], whole: Path, whole_spec: BenchmarkSpec, tmp_path: Path
) -> None:
    flow = run(spec_of({"flow": checkpoints["fmp"]}, n_repeats=2), tmp_path)
    assert outcomes(flow, "flow") == outcomes(rows_of(whole), "fmp")
    assert {(row.plans_drawn, row.n_plans, row.plan_flagged) for row in flow} == {(None, None, None)}
    assert "flagged" not in (tmp_path / "table.md").read_text()


def forgetful(checkpoint: str, folder: Path) -> str:
    """The same checkpoint with a field from before plans were calibrated."""
    policy, preprocessor, postprocessor = load_policy(checkpoint, device="cpu")
    loaded_demonstrations(preprocessor).calibration.plans.forget()
    for part in (policy, preprocessor, postprocessor):
        part.save_pretrained(folder)
    return str(folder)


@pytest.mark.parametrize("guidance", ["none", "proximal:0.8"])
def test_a_field_that_is_not_calibrated_for_plans_is_an_error_that_says_what_to_do(
    checkpoints: dict[str, str],
    tmp_path: Path,
    evaluations: list[float],
    caplog: pytest.LogCaptureFixture,
    guidance: str,
) -> None:
    policies = {"pf2mp": forgetful(checkpoints["pf2mp"], tmp_path / "before")}
    message = (
        "the check of plans needs demonstrated plans, got a potential field without them: pf2mp-fit-field"
    )
    with pytest.raises(ValueError, match=f"^{message} makes .*, and max_plans=1 with .* needs none$"):
        run_benchmark(spec_of(policies, guidance), tmp_path / "benchmark")
    said = [record.message for record in caplog.records if record.name.startswith("lerobot_pf2mp")]
    assert evaluations == [] and said == []
    rows = run(spec_of(policies, guidance, variants={"": {"max_plans": 1}}), tmp_path / "benchmark_of_one")
    assert {(row.plans_drawn, row.n_plans, row.plan_flagged) for row in rows} == {(None, None, None)}


def test_an_unguided_policy_without_a_field_is_evaluated_without_measuring_its_plans(
    checkpoints: dict[str, str], tmp_path: Path
) -> None:
    policy, preprocessor, postprocessor = load_policy(checkpoints["pf2mp"], device="cpu", guidance_scale=0)
    for step in preprocessor.steps:
        if isinstance(step, PotentialFieldProcessorStep):
            step.demonstrations = DemonstratedActions(step.demonstrations.settings)
    for part in (policy, preprocessor, postprocessor):
        part.save_pretrained(tmp_path / "unfitted")
    rows = run(spec_of({"pf2mp": str(tmp_path / "unfitted")}), tmp_path / "benchmark")
    assert [row.n_plans for row in rows] == [None] * N_EPISODES


def test_results_from_before_plans_were_counted_are_added_to(
    copied: Path, whole_spec: BenchmarkSpec, evaluations: list[float]
) -> None:
    lines = [line.split(",") for line in (copied / "episodes.csv").read_text().splitlines()]
    old = "".join(",".join(line[:-4]) + "\n" for line in lines[: 1 + 2 * N_EPISODES])
    (copied / "episodes.csv").write_text(old)
    rows = run(whole_spec, copied)
    assert len(evaluations) == 4
    assert [row.n_plans for row in rows] == [None] * (2 * N_EPISODES) + [N_CHUNKS] * (4 * N_EPISODES)
    assert (copied / "episodes.csv").read_text().splitlines()[0] == COLUMNS


def test_the_first_observation_of_many_has_its_cameras() -> None:
    pixels = {"front": np.arange(24).reshape(3, 2, 4), "wrist": np.zeros((3, 1))}
    first = evaluation._of_first({"agent_pos": np.arange(6).reshape(3, 2), "pixels": pixels})
    assert first["agent_pos"].tolist() == [[0, 1]]
    assert first["pixels"]["front"].tolist() == [[[0, 1, 2, 3], [4, 5, 6, 7]]]
    assert first["pixels"]["wrist"].shape == (1, 1)


# The same for all


@pytest.mark.slow
def test_all_policies_get_the_same_pairs_and_in_every_repeat_the_same_noise_and_other_repeats_other_noise(
    checkpoints: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chunks: list[tuple[Tensor, Tensor]] = []  # observed positions and goals, and the prior noise
    predict, integrate = PF2MPPolicy.predict_action_chunk, modeling_fmp.integrate
    observed: list[Tensor] = []

    def observing(self: PF2MPPolicy, batch: dict, **options: Any) -> Tensor:
        observed.append(HALF_WIDTH * torch.cat([batch[key].reshape(-1, 2) for key in (STATE, ENV)], dim=1))
        chunk = predict(self, batch, **options)
        if self.config.guidance_scale:
            torch.rand(5)  # as a policy might that draws noise on its way, too
        return chunk

    def integrating(velocity: Any, x_0: Tensor, *arguments: Any, **options: Any) -> Tensor:
        if observed:  # the first plan, which others may follow
            positions = observed.pop()
            if len(x_0) > 1:  # not the measurement of the latency
                chunks.append((positions, x_0.clone()))
        return integrate(velocity, x_0, *arguments, **options)

    monkeypatch.setattr(PF2MPPolicy, "predict_action_chunk", observing)
    monkeypatch.setattr(modeling_fmp, "integrate", integrating)
    guidances = ("none", "proximal:0.8", "euler:0.01")
    run(spec_of({"pf2mp": checkpoints["pf2mp"]}, *guidances, n_repeats=2, n_episodes=4), tmp_path)

    n_chunks = 2 * 2  # two rollouts of two environments, six steps of which take two chunks of four actions
    n_jobs = len(guidances) * 2
    assert len(chunks) == n_jobs * n_chunks
    jobs = [chunks[i : i + n_chunks] for i in range(0, len(chunks), n_chunks)]
    maze = MazeEnv("umaze")
    starts = [maze.reset(seed=EPISODE_SEED + episode)[0] for episode in range(4)]
    expected = torch.tensor([[*start["agent_pos"], *start["environment_state"]] for start in starts])
    for job in jobs:
        first_chunks = torch.cat([positions for positions, _ in job[::2]])
        torch.testing.assert_close(first_chunks, expected)
    noise = [torch.cat([x_0 for _, x_0 in job]) for job in jobs]
    for repeat in (0, 1):
        for guided in noise[repeat + 2 :: 2]:
            assert torch.equal(noise[repeat], guided)
    every_chunk = torch.cat([noise[0], noise[1]]).flatten(1)
    assert len(every_chunk.unique(dim=0)) == len(every_chunk) == 2 * n_chunks * 2


@pytest.mark.slow
def test_repeats_differ_in_the_noise_alone_and_without_guidance_a_policy_is_its_unguided_kind(
    checkpoints: dict[str, str], tmp_path: Path
) -> None:
    # fmp and pf2mp have the same weights, and so have diffusion and dppf; act draws no noise.
    policies = {"flow" if kind == "fmp" else kind: path for kind, path in checkpoints.items()}
    rows = run(spec_of(policies, n_repeats=2), tmp_path)
    for name, unguided in (("flow", "fmp"), ("diffusion", "dp")):
        assert len(outcomes(rows, name)) == 2 * N_EPISODES
        assert outcomes(rows, name) == outcomes(rows, unguided)
    assert outcomes(rows, "flow") != outcomes(rows, "diffusion")
    for policy, draws_noise in (("flow", True), ("diffusion", True), ("act", False)):
        first, second = (
            [episode[3:] for episode in outcomes(rows, policy, repeat=repeat)] for repeat in (0, 1)
        )
        for left, right in zip(first, second, strict=True):
            assert (left != right) == draws_noise


@pytest.mark.slow
def test_results_do_not_depend_on_what_ran_before(
    checkpoints: dict[str, str], whole: Path, whole_spec: BenchmarkSpec, tmp_path: Path
) -> None:
    others = {"act": checkpoints["act"], **whole_spec.policies}
    spec = replace(whole_spec, policies=others, guidances=whole_spec.guidances[::-1])
    rows = [row for row in run(spec, tmp_path) if row.policy in ("fmp", "pf2mp")]
    assert sorted(rows, key=repr) == sorted(timeless(rows_of(whole)), key=repr)


@pytest.mark.slow
def test_the_same_command_gives_the_same_file_but_for_latency_and_commit(
    whole: Path, whole_spec: BenchmarkSpec, tmp_path: Path
) -> None:
    torch.manual_seed(123)
    run_benchmark(whole_spec, tmp_path)
    others = {COLUMNS.split(",").index(name) for name in ("chunk_latency_ms", "commit")}
    first, second = (
        [
            [field for i, field in enumerate(line.split(",")) if i not in others]
            for line in (folder / "episodes.csv").read_text().splitlines()
        ]
        for folder in (whole, tmp_path)
    )
    assert first == second


@pytest.mark.slow
def test_processes_side_by_side_give_the_same_rows_in_the_same_order(
    whole: Path, whole_spec: BenchmarkSpec, tmp_path: Path
) -> None:
    assert torch.get_num_threads() == 1  # as in each of those processes
    run_benchmark(whole_spec, tmp_path, n_processes=2)
    assert timeless(rows_of(tmp_path)) == timeless(rows_of(whole))


# Going on


def assert_goes_on(
    folder: Path, spec: BenchmarkSpec, whole: Path, evaluations: list[float], n_kept: int
) -> None:
    """Running the benchmark again completes what is missing after the first `n_kept` repeats, and only that."""
    expected = rows_of(whole)
    n_rows = n_kept * N_EPISODES
    summary = run_benchmark(spec, folder)
    assert evaluations == [row.guidance_scale for row in expected[n_rows::N_EPISODES]]
    rows = rows_of(folder)
    assert rows[:n_rows] == expected[:n_rows]  # as they were, latency included
    assert timeless(rows) == timeless(expected)
    assert summary == read_rows(folder / "summary.csv", SummaryRow)
    assert [(row.policy, row.repeat, row.collisions, row.successes) for row in summary] == [
        (row.policy, row.repeat, row.collisions, row.successes)
        for row in read_rows(whole / "summary.csv", SummaryRow)
    ]


@pytest.mark.parametrize(
    ("n_lines", "n_more_characters", "n_kept"),
    [
        (1 + 6 * N_EPISODES, 0, 6),  # finished
        (1 + 5 * N_EPISODES, 0, 5),
        (6 * N_EPISODES, 57, 5),  # the last line is whole but for its end
        (1 + 4 * N_EPISODES, 1, 4),
        (2 + 3 * N_EPISODES, 30, 3),
    ],
)
def test_a_benchmark_that_was_cut_short_goes_on_where_it_was(
    copied: Path,
    whole: Path,
    whole_spec: BenchmarkSpec,
    evaluations: list[float],
    n_lines: int,
    n_more_characters: int,
    n_kept: int,
) -> None:
    lines = (copied / "episodes.csv").read_text().splitlines(keepends=True)
    left = "".join(lines[:n_lines]) + "".join(lines[n_lines:])[:n_more_characters]
    (copied / "episodes.csv").write_text(left)
    for name in ("summary.csv", "table.md", "table.tex"):
        (copied / name).unlink()
    assert_goes_on(copied, whole_spec, whole, evaluations, n_kept)


@pytest.mark.slow
def test_an_interruption_leaves_the_repeats_that_are_done(
    whole: Path,
    whole_spec: BenchmarkSpec,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    evaluations: list[float],
) -> None:
    counted = evaluation.eval_policy

    def interrupted(*arguments: Any, **options: Any) -> Any:
        if len(evaluations) == 2:
            raise KeyboardInterrupt
        return counted(*arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(evaluation, "eval_policy", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_benchmark(whole_spec, tmp_path)
    assert timeless(rows_of(tmp_path)) == timeless(rows_of(whole))[: 2 * N_EPISODES]
    shutil.copyfile(tmp_path / "episodes.csv", tmp_path / "before.csv")
    evaluations.clear()
    assert run(whole_spec, tmp_path) == timeless(rows_of(whole))
    assert len(evaluations) == 4
    assert (tmp_path / "episodes.csv").read_text().startswith((tmp_path / "before.csv").read_text())


@pytest.mark.slow
@pytest.mark.parametrize(
    "begin",
    [
        lambda spec: replace(spec, guidances=spec.guidances[:1]),
        lambda spec: replace(spec, guidances=spec.guidances[1:], n_repeats=1),
    ],
    ids=["none, then guidance", "guidance, then none and another repeat"],
)
def test_a_second_call_adds_what_is_new(
    whole: Path,
    whole_spec: BenchmarkSpec,
    tmp_path: Path,
    evaluations: list[float],
    begin: Callable[[BenchmarkSpec], BenchmarkSpec],
) -> None:
    run_benchmark(begin(whole_spec), tmp_path)
    first = (tmp_path / "episodes.csv").read_text()
    summary = run_benchmark(whole_spec, tmp_path)
    assert (tmp_path / "episodes.csv").read_text().startswith(first)
    assert len(evaluations) == 6
    assert sorted(timeless(rows_of(tmp_path)), key=repr) == sorted(timeless(rows_of(whole)), key=repr)
    for row in summary:  # those that are guided now have a twin
        assert (row.only_unguided_collides is None) == (row.guidance_scale == 0)
    assert (tmp_path / "table.md").read_text().count(UMAZE) == 3


def test_rows_of_a_policy_that_is_not_asked_for_any_more_stay(
    checkpoints: dict[str, str], copied: Path, whole_spec: BenchmarkSpec, evaluations: list[float]
) -> None:
    before = rows_of(copied)
    rows = run(replace(whole_spec, policies={"act": checkpoints["act"]}), copied)
    assert len(evaluations) == 2
    assert rows[: len(before)] == timeless(before)
    assert {row.policy for row in rows[len(before) :]} == {"act"}


@pytest.mark.parametrize(
    "change",
    [
        {"n_episodes": 4},
        {"episode_seed": 8},
        {"batch_size": 3},
        {"env": PF2MPMazeEnv(task=UMAZE, episode_length=7)},
        {"env": PF2MPMazeEnv(task=UMAZE, episode_length=EPISODE_LENGTH, control="pd")},
    ],
    ids=["n_episodes", "episode_seed", "batch_size", "episode_length", "control"],
)
def test_other_episodes_in_the_same_folder_are_an_error(
    copied: Path, whole: Path, whole_spec: BenchmarkSpec, evaluations: list[float], change: dict[str, Any]
) -> None:
    with pytest.raises(
        ValueError, match="holds a benchmark over other episodes .* choose another --output_dir"
    ):
        run_benchmark(replace(whole_spec, **change), copied)
    assert evaluations == []
    for path in whole.iterdir():
        assert (copied / path.name).read_bytes() == path.read_bytes()


def test_settings_that_did_not_exist_when_a_benchmark_began_had_their_defaults(
    copied: Path, whole_spec: BenchmarkSpec, evaluations: list[float]
) -> None:
    mark = copied / "run.json"
    content = json.loads(mark.read_text())
    assert content["episodes"]["env"].pop("control") == PF2MPMazeEnv().control == "exact"
    mark.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="other episodes"):
        run_benchmark(replace(whole_spec, env=replace(whole_spec.env, control="pd")), copied)
    run_benchmark(whole_spec, copied)
    assert evaluations == []
    assert json.loads(mark.read_text())["episodes"]["env"]["control"] == "exact"


def test_another_checkpoint_of_the_same_name_in_the_same_folder_is_an_error(
    checkpoints: dict[str, str],
    copied: Path,
    whole: Path,
    whole_spec: BenchmarkSpec,
    evaluations: list[float],
    tmp_path: Path,
) -> None:
    other = shutil.copytree(checkpoints["pf2mp"], tmp_path / "other")
    message = f"holds results of 'fmp' from {checkpoints['pf2mp']}, got {other}: choose another name"
    with pytest.raises(ValueError, match=re.escape(message)):
        run_benchmark(replace(whole_spec, policies={"pf2mp": str(other)}, variants={"new": {}}), copied)
    assert evaluations == []
    for path in whole.iterdir():
        assert (copied / path.name).read_bytes() == path.read_bytes()


def test_another_meaning_of_a_variant_in_the_same_folder_is_an_error(
    checkpoints: dict[str, str], tmp_path: Path
) -> None:
    policies = {"pf2mp": checkpoints["pf2mp"]}
    rows = run(spec_of(policies, variants={"fast": {"num_inference_steps": 1}}), tmp_path)
    with pytest.raises(ValueError, match="'fast'"):
        run_benchmark(spec_of(policies, variants={"fast": {"num_inference_steps": 3}}), tmp_path)
    assert timeless(rows_of(tmp_path)) == rows
    assert json.loads((tmp_path / "run.json").read_text())["variants"]["fast"] == {"num_inference_steps": 1}


def test_another_variant_is_added_and_both_are_noted(
    copied: Path, whole_spec: BenchmarkSpec, evaluations: list[float]
) -> None:
    variants = {"fast": {"num_inference_steps": 1}}
    spec = replace(whole_spec, variants=variants, guidances=(NONE,))
    rows = run(spec, copied)
    assert len(evaluations) == 2
    assert Counter(row.variant for row in rows) == {"": 6 * N_EPISODES, "fast": 2 * N_EPISODES}
    assert json.loads((copied / "run.json").read_text())["variants"] == {"": {}, **variants}


def test_another_task_of_the_same_environment_is_added(
    copied: Path, whole_spec: BenchmarkSpec, evaluations: list[float]
) -> None:
    env = replace(whole_spec.env, task="MazeMedium-v0")
    rows = run(replace(whole_spec, env=env, tasks=(UMAZE, "MazeMedium-v0"), guidances=(NONE,)), copied)
    assert evaluations == [0.0, 0.0]
    assert Counter(row.task for row in rows) == {UMAZE: 6 * N_EPISODES, "MazeMedium-v0": 2 * N_EPISODES}


# Loading


def test_checkpoints_below_the_home_folder_are_found(
    checkpoints: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(Path(checkpoints["pf2mp"]).parent))
    rows = run(spec_of({"pf2mp": "~/pf2mp"}, "proximal:0.8"), tmp_path)
    assert outcomes(rows, "pf2mp")
    assert {row.checkpoint for row in rows} == {"~/pf2mp"}


def test_loading_refuses_what_is_neither_folder_nor_repository(
    checkpoints: dict[str, str], tmp_path: Path
) -> None:
    with pytest.raises(FileNotFoundError, match="a checkpoint's pretrained_model folder or a repository"):
        load_policy(tmp_path / "nothing")
    policy, _, _ = load_policy(checkpoints["pf2mp"], device="cpu", guidance_scale=0.25)
    assert policy.config.guidance_scale == 0.25
    assert not policy.training
    assert isinstance(policy.config, FMPConfig)
