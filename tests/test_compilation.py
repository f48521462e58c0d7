# SPDX-License-Identifier: Apache-2.0
"""Policies and fields under ``torch.compile``."""

import math
from typing import Any

import pytest
import torch
from demonstrated_paths import paths, some_periods, turning_paths
from lerobot.configs import FeatureType, PolicyFeature
from torch import Tensor

from lerobot_pf2mp import FMPConfig, PF2MPConfig
from lerobot_pf2mp.density import kernel_tree
from lerobot_pf2mp.density.kernel_sums import KernelSums
from lerobot_pf2mp.policies.batch_keys import POTENTIAL_FIELD
from lerobot_pf2mp.policies.fmp.modeling_fmp import FMPPolicy
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.pf2mp.modeling_pf2mp import PF2MPPolicy
from lerobot_pf2mp.potential_field import PotentialField, fit

HORIZON, ACTION_DIM, STATE = 16, 2, "observation.state"

pytestmark = pytest.mark.usefixtures("_fresh_compiler")


@pytest.fixture
def _fresh_compiler() -> None:
    torch.compiler.reset()


@pytest.fixture(params=["extension", "attention"])
def sums(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Kernel sums from the C extension, and from attention as if it could not be built."""
    if request.param == "attention":
        monkeypatch.setattr("lerobot_pf2mp.density.kernel_tree._kernel_tree", None)
    elif not kernel_tree.is_available():
        pytest.skip("the C extension could not be built")
    return request.param


def policy_of(kind: str, **options: Any) -> Any:
    make_config, make_policy = {"fmp": (FMPConfig, FMPPolicy), "pf2mp": (PF2MPConfig, PF2MPPolicy)}[kind]
    torch.manual_seed(0)
    config = make_config(
        device="cpu",
        horizon=HORIZON,
        n_action_steps=HORIZON,
        down_dims=(8, 16),
        n_groups=4,
        diffusion_step_embed_dim=16,
        input_features={STATE: PolicyFeature(FeatureType.STATE, (3,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTION_DIM,))},
        **options,
    )
    return make_policy(config).eval()


def batches_for(policy: Any, n: int) -> list[dict[str, Any]]:
    """Observations, each with the field over the same demonstrations."""
    generator = torch.Generator().manual_seed(1)
    batches: list[dict[str, Any]] = [{STATE: torch.rand(1, 3, generator=generator)} for _ in range(n)]
    if isinstance(policy, PF2MPPolicy):
        demonstrated = DemonstratedActions(policy.config.field_settings)
        actions = 0.2 * torch.randn(40, HORIZON, ACTION_DIM, generator=generator)
        demonstrated.observe(
            actions,
            None,
            HORIZON * torch.arange(40),
            torch.arange(40),
            settings=policy.config.field_settings,
            n_executed=HORIZON,
        )
        batches = [{**batch, POTENTIAL_FIELD: demonstrated} for batch in batches]
    return batches


def noises(n: int) -> list[Tensor]:
    return [
        torch.randn(1, HORIZON, ACTION_DIM, generator=torch.Generator().manual_seed(seed))
        for seed in range(n)
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("fmp", {}),
        ("pf2mp", {}),
        ("pf2mp", {"guidance_integrator": "euler", "guidance_scale": 0.001}),
        ("pf2mp", {"field_alpha": 0.0}),
        ("pf2mp", {"field_action_dims": (0, 1)}),
        ("pf2mp", {"compile_model": True}),
    ],
    ids=str,
)
def test_a_compiled_policy_plans_the_same_and_is_compiled_once(kind: str, options: dict[str, Any]) -> None:
    policy, n = policy_of(kind, **options), 4
    batches, noise = batches_for(policy, n), noises(n)
    compiled = torch.compile(policy.predict_action_chunk, backend="eager")
    with torch.inference_mode(), torch._dynamo.config.patch(error_on_recompile=True):
        # As lerobot-rollout does it: the compiled policy is the first one to ask for the field.
        found = [compiled(dict(batch), noise=x_0) for batch, x_0 in zip(batches, noise, strict=True)]
    plain = policy_of(kind, **{**options, "compile_model": False})
    for chunk, batch, x_0 in zip(found, batches, noise, strict=True):
        wanted = plain.predict_action_chunk(batch, noise=x_0)
        torch.testing.assert_close(chunk, wanted, rtol=1e-4, atol=1e-5)
    assert not torch.equal(found[0], found[1])


@pytest.mark.slow
def test_the_steps_of_a_guided_policy_are_one_graph(sums: str) -> None:
    policy = policy_of("pf2mp")
    (batch,), (noise,) = batches_for(policy, 1), noises(1)
    guide = policy.guidance.guide(batch, torch.device("cpu"))
    compiled = torch.compile(policy.predict_action_chunk, backend="eager", fullgraph=True)
    chunk = compiled({STATE: batch[STATE]}, noise=noise, guide=guide)
    torch.testing.assert_close(chunk, policy.predict_action_chunk(batch, noise=noise), rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_compiled_policy_watches_its_plans() -> None:
    policy = policy_of("pf2mp", on_unsupported="warn", guidance_scale=0.0)
    (batch,), (noise,) = batches_for(policy, 1), noises(1)
    torch.manual_seed(2)
    chunk = torch.compile(policy.predict_action_chunk, backend="eager")(dict(batch), noise=3 * noise)
    support = policy.support
    assert policy.plans.n_drawn.tolist() == [8]
    policy.reset()
    torch.manual_seed(2)
    torch.testing.assert_close(chunk, policy.predict_action_chunk(batch, noise=3 * noise))
    assert (support < 0).any()
    torch.testing.assert_close(support, policy.support)


@pytest.mark.parametrize("is_prepared", [True, False])
def test_compiled_sums_are_the_same(is_prepared: bool, sums: str) -> None:
    kernel_sums = KernelSums(paths(1000, 2), 0.02)
    queries = paths(100, 2, seed=1)
    wanted = KernelSums(kernel_sums.anchors, 0.02)(queries)
    if is_prepared:
        kernel_sums(queries[:1])
    found = torch.compile(kernel_sums.__call__, backend="eager", fullgraph=True)(queries)
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("is_prepared", [True, False])
@pytest.mark.parametrize("n_angles", [1, 2])
def test_compiled_sums_over_angles_are_the_same(n_angles: int, is_prepared: bool, sums: str) -> None:
    periods = some_periods(2, n_angles)
    kernel_sums = KernelSums(turning_paths(1000, periods), 0.02, periods)
    queries = turning_paths(100, periods, seed=1)
    wanted = KernelSums(kernel_sums.anchors, 0.02, periods)(queries)
    if is_prepared:
        kernel_sums(queries[:1])
    found = torch.compile(kernel_sums.__call__, backend="eager", fullgraph=True)(queries)
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.skipif(not kernel_tree.is_available(), reason="the C extension could not be built")
def test_compiled_steps_over_angles_are_the_same() -> None:
    periods = some_periods(2, 1)
    tree = KernelSums(turning_paths(1000, periods), 0.02, periods).tree
    targets = KernelSums(turning_paths(100, periods), 0.02, periods).tree
    queries = turning_paths(100, periods, seed=1)
    for method, arguments in ((tree.steps_to, (0.5, 0.1)), (tree.offsets_to, ())):
        found = torch.compile(method, backend="eager", fullgraph=True)(targets, queries, 3.0, *arguments)
        wanted = method(targets, queries, 3.0, *arguments)
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_compiled_field_is_the_same(sums: str) -> None:
    points = paths(1000, 2)
    field = fit(points, threshold_quantile=0.2, alpha=-1.0).prepared
    a = points[:200] + 5 * field.bandwidth * torch.randn(200, 2)
    assert (field.offset_to_safe_set(a) != 0).any()
    for lookup, arguments in (
        (PotentialField.log_density, ()),
        (PotentialField.score, ()),
        (PotentialField.offset_to_safe_set, ()),
        (PotentialField.potential_gradient, ()),
        (PotentialField.step_to_safety, (0.5, 0.1)),
    ):
        found = torch.compile(lookup, backend="eager", fullgraph=True)(field, a, *arguments)
        torch.testing.assert_close(found, lookup(field, a, *arguments), rtol=1e-4, atol=1e-4)


@pytest.mark.skipif(not kernel_tree.is_available(), reason="the C extension could not be built")
@pytest.mark.parametrize("n_angles", [0, 1])
def test_the_extensions_operators_are_proper_ones(n_angles: int) -> None:
    periods = some_periods(2, n_angles)
    parts = KernelSums(paths(300, 2), 0.05, periods).tree._parts
    targets = KernelSums(paths(100, 2), 0.05, periods).tree._parts
    queries = paths(50, 2, seed=1)
    torch.library.opcheck(kernel_tree._sums_operator, (*parts, queries))
    for pull in ((math.inf, math.inf), (-1.0, 2.0)):
        torch.library.opcheck(
            kernel_tree._steps_operator, (*parts, *targets, queries, 0.5, 0.3, 0.1, *pull, 1.5)
        )
