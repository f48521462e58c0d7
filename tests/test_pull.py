# SPDX-License-Identifier: Apache-2.0
"""Fields that pull only where support is missing."""

import math
import subprocess
import sys
from dataclasses import replace
from typing import Any

import pytest
import torch
from demonstrated_paths import brute_force, differences, paths, some_periods, turning_paths
from torch import Tensor

from lerobot_pf2mp.density import kernel_tree
from lerobot_pf2mp.density.pull import Pull
from lerobot_pf2mp.guidance import GuidanceSettings, make_guide
from lerobot_pf2mp.potential_field import PotentialField, fit

# What follows is the specification in its most obvious form: one number at a time.


def weight_of(log_density: float, full: float, none: float) -> float:
    if full == none:
        return 1.0 if log_density < none else 0.0
    return min(max((none - log_density) / (none - full), 0.0), 1.0)


def integral_of(log_density: float, full: float, none: float) -> float:
    if full == none:
        return min(log_density, none)
    if log_density <= full:
        return log_density
    if log_density >= none:
        return (full + none) / 2
    return full + ((none - full) ** 2 - (none - log_density) ** 2) / (2 * (none - full))


def weights_of(log_density: Tensor, full: float, none: float) -> Tensor:
    return torch.tensor([weight_of(x, full, none) for x in log_density.flatten().tolist()]).view_as(
        log_density
    )


def some_field(n_angles: int = 0, **options: Any) -> tuple[PotentialField, Tensor]:
    """A field over paths, and ``(20, 25, 2)`` actions on and beside them."""
    periods = some_periods(2, n_angles) if n_angles else None
    anchors = paths(800, 2) if periods is None else turning_paths(800, periods)
    field = fit(anchors, periods=periods, bandwidth=0.05, threshold_quantile=0.3, **options)
    a = anchors[:500] + 0.1 * torch.randn(500, 2)
    return field, a.reshape(20, 25, 2)


def limited(field: PotentialField, a: Tensor, low: float = 0.2, high: float = 0.7) -> PotentialField:
    """The field that pulls less above the lower, and not above the higher of two quantiles of the actions' densities."""
    full, none = field.log_density(a).quantile(torch.tensor([low, high])).tolist()
    return replace(field, log_full_pull=full, log_no_pull=none)


@pytest.fixture(params=["extension", "torch", "compiled extension", "compiled torch"])
def call(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Calls a method as each engine does it: the extension or torch alone, one operation at a time or as one graph."""
    if "torch" in request.param:
        monkeypatch.setattr("lerobot_pf2mp.density.kernel_tree._kernel_tree", None)
    elif not kernel_tree.is_available():
        pytest.skip("the C extension could not be built")
    if "compiled" not in request.param:
        return lambda method, field, *arguments: method(field, *arguments)
    torch.compiler.reset()
    return lambda method, field, *arguments: torch.compile(method, backend="eager", fullgraph=True)(
        field.prepared, *arguments
    )


@pytest.mark.parametrize(("full", "none"), [(-3.0, 1.0), (-200.0, -199.5), (0.75, 0.75)])
def test_the_weight_and_its_integral_follow_their_formulas(full: float, none: float) -> None:
    pull = Pull(full, none)
    inside = torch.linspace(full, none, 9)
    log_density = torch.cat([torch.tensor([-1e30, -500.0, full - 1]), inside, torch.tensor([none + 1, 1e30])])
    values = log_density.tolist()
    weights, integrals = pull.weight(log_density), pull.integral(log_density)
    torch.testing.assert_close(weights, torch.tensor([weight_of(x, full, none) for x in values]))
    torch.testing.assert_close(integrals, torch.tensor([integral_of(x, full, none) for x in values]))
    assert (weights[:3] == 1).all() and (weights[-2:] == 0).all()


def test_by_default_the_density_pulls_everywhere_and_nothing_changes_by_a_bit() -> None:
    field, a = some_field()
    score = (field.local_mean(a) - a) / 0.05**2
    torch.testing.assert_close(field.potential_gradient(a), score, rtol=1e-3, atol=1e-2)
    assert torch.equal(field.potential_gradient(a), field.score(a))
    assert torch.equal(field.potential(a), field.log_density(a))
    assert torch.equal(field.step_to_safety(a, 0.7, 0.0), 0.7 * field.mean_shift(a))
    above_all = replace(field, log_full_pull=1e3, log_no_pull=1e3)
    assert torch.equal(above_all.step_to_safety(a, 0.7, 0.1), field.step_to_safety(a, 0.7, 0.1))


@pytest.mark.parametrize("max_distance", [0.0, 0.02])
@pytest.mark.parametrize("n_angles", [0, 1])
@pytest.mark.parametrize("shape", [(20, 25, 2), (500, 2), (2,)])
def test_every_engine_takes_the_weighted_step(
    call: Any, shape: tuple[int, ...], n_angles: int, max_distance: float
) -> None:
    plain, every = some_field(n_angles, alpha=-1.0)
    a = every.reshape(-1, 2)[: math.prod(shape) // 2].reshape(shape)
    field = limited(plain, every)
    found = call(PotentialField.step_to_safety, field, a, 0.6, max_distance)
    assert found.shape == shape and found.dtype == torch.float32
    flat, h = a.reshape(-1, 2), field.bandwidth
    shifts, log_sums = brute_force(flat, field.anchors, h, field.periods)
    log_normaliser = math.log(len(field.anchors)) + 2 * math.log(h * math.sqrt(2 * math.pi))
    weights = weights_of(log_sums - log_normaliser, field.log_full_pull, field.log_no_pull)
    steps = 0.6 * weights.unsqueeze(1) * shifts
    ends = flat + steps
    there = brute_force(ends, field.anchors, h, field.periods)[1] - log_normaliser - field.log_threshold
    ways = differences(ends, field.anchors[field.safe_anchors], field.periods)
    ways = ways[torch.arange(len(flat)), ways.norm(dim=-1).argmin(dim=1)]
    lengths = ways.norm(dim=-1, keepdim=True).clamp_min(max(max_distance, 1e-9))
    wanted = steps + (there <= 0).unsqueeze(1) * ways * (max_distance / lengths)
    is_clear = there.abs() > 1e-3
    torch.testing.assert_close(found.reshape(-1, 2)[is_clear], wanted[is_clear].float(), rtol=1e-3, atol=1e-5)
    if len(flat) > 1:
        assert is_clear.sum() > 0.98 * len(flat)
        for is_one in (weights == 0, weights == 1, (weights > 0.05) & (weights < 0.95)):
            assert is_one.sum() > 60


@pytest.mark.parametrize("alpha", [0.0, -3.0])
def test_every_engine_weights_the_score_in_the_gradient(call: Any, alpha: float) -> None:
    plain, a = some_field(alpha=alpha)
    field = limited(plain, a)
    weights = weights_of(plain.log_density(a), field.log_full_pull, field.log_no_pull).unsqueeze(-1)
    distance_term = plain.potential_gradient(a) - plain.score(a)
    found = call(PotentialField.potential_gradient, field, a)
    torch.testing.assert_close(found, weights * plain.score(a) + distance_term, rtol=1e-3, atol=1e-2)
    without = replace(field, alpha=0.0)
    torch.testing.assert_close(
        call(PotentialField.potential, without, a),
        torch.tensor(
            [
                integral_of(x, field.log_full_pull, field.log_no_pull)
                for x in plain.log_density(a).flatten().tolist()
            ]
        ).view(20, 25),
        rtol=1e-4,
        atol=1e-4,
    )


@pytest.mark.parametrize("has_extension", [True, False])
@pytest.mark.parametrize("shape", [(0, 2), (3, 0, 2)])
def test_no_actions_need_no_step(
    shape: tuple[int, ...], has_extension: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not has_extension:
        monkeypatch.setattr("lerobot_pf2mp.density.kernel_tree._kernel_tree", None)
    field = limited(*some_field(alpha=-1.0))
    for max_distance in (0.0, 0.1):
        assert field.step_to_safety(torch.zeros(shape), 0.5, max_distance).shape == shape
    assert field.potential_gradient(torch.zeros(shape)).shape == shape
    assert field.potential(torch.zeros(shape)).shape == shape[:-1]


def test_the_density_itself_does_not_depend_on_where_it_pulls() -> None:
    plain, a = some_field()
    field = limited(plain, a)
    for method in ("log_density", "score", "mean_shift", "local_mean", "is_safe", "offset_to_safe_set"):
        assert torch.equal(getattr(field, method)(a), getattr(plain, method)(a))


@pytest.mark.parametrize(("low", "high"), [(0.2, 0.7), (0.5, 0.5)])
@pytest.mark.parametrize("alpha", [0.0, -3.0])
def test_the_gradient_is_that_of_the_potential(alpha: float, low: float, high: float) -> None:
    plain, a = some_field(alpha=alpha)
    field = limited(plain, a, low, high)
    full, none = field.log_full_pull, field.log_no_pull
    log_density = field.log_density(a)
    kinks = torch.tensor([full, none, field.log_threshold])
    a = a[(log_density.unsqueeze(-1) - kinks).abs().amin(dim=-1) > 0.05]

    def potential(x: Tensor) -> Tensor:
        squares = (x.unsqueeze(-2) - field.anchors.double()).square().sum(dim=-1)  # (..., M)
        log_normaliser = math.log(len(field.anchors)) + 2 * math.log(0.05 * math.sqrt(2 * math.pi))
        log_p = torch.logsumexp(-squares / (2 * 0.05**2), dim=-1) - log_normaliser
        is_outside = log_p <= field.log_threshold
        distance = torch.cdist(x, field.anchors[field.safe_anchors].double()).amin(dim=-1)
        ramp = (
            full + ((none - full) ** 2 - (none - log_p) ** 2) / (2 * (none - full)) if none > full else none
        )
        psi = torch.where(
            log_p <= full, log_p, torch.where(log_p >= none, torch.tensor((full + none) / 2), ramp)
        )
        return psi + alpha * distance * is_outside

    torch.testing.assert_close(field.potential(a).double(), potential(a.double()), rtol=1e-4, atol=1e-3)
    x = a.double().requires_grad_()
    (gradient,) = torch.autograd.grad(potential(x).sum(), x)
    torch.testing.assert_close(field.potential_gradient(a).double(), gradient, rtol=1e-3, atol=2e-2)
    step = 1e-6 * torch.eye(2, dtype=torch.float64)
    around = a.double().unsqueeze(1)
    numeric = (potential(around + step) - potential(around - step)) / 2e-6
    torch.testing.assert_close(numeric, gradient, rtol=1e-4, atol=1e-3)
    assert len(a) > 300


@pytest.mark.parametrize("has_extension", [True, False])
def test_an_action_exactly_at_the_step_is_not_pulled(
    has_extension: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not has_extension:
        monkeypatch.setattr("lerobot_pf2mp.density.kernel_tree._kernel_tree", None)
    plain, a = some_field()
    for i in range(5):
        tau = plain.log_density(a)[i, 0].item()
        steps = replace(plain, log_full_pull=tau, log_no_pull=tau).step_to_safety(a, 0.5, 0.0)
        assert (steps[i, 0] == 0).all()
        is_pulled = (plain.log_density(a) < tau).unsqueeze(-1)
        assert torch.equal(steps, torch.where(is_pulled, 0.5 * plain.mean_shift(a), 0.0))


@pytest.mark.parametrize("distance", [1e3, 1e9, 1e30])
def test_far_away_the_pull_is_full_and_finite(call: Any, distance: float) -> None:
    plain, a = some_field(alpha=-1.0)
    far = distance * torch.nn.functional.normalize(torch.randn(10, 2), dim=-1)
    found = call(PotentialField.step_to_safety, limited(plain, a), far, 0.5, 0.1)
    assert found.isfinite().all()
    assert torch.equal(found, plain.step_to_safety(far, 0.5, 0.1))


@pytest.mark.parametrize("alpha", [0.0, -1.0])
@pytest.mark.parametrize(("integrator", "scale"), [("euler", 0.01), ("proximal", 0.8)])
def test_a_guide_leaves_alone_what_is_supported(integrator: str, scale: float, alpha: float) -> None:
    plain, a = some_field(alpha=alpha)
    field = limited(plain, a)
    field = replace(field, log_threshold=field.log_no_pull)
    settings = GuidanceSettings(scale, integrator, "next")
    guided = make_guide(field, settings)(a, a, a, 0.2)
    everywhere = make_guide(plain, settings)(a, a, a, 0.2)
    is_supported = plain.log_density(a) > field.log_no_pull
    assert torch.equal(guided[is_supported], a[is_supported])
    assert (guided[~is_supported] != a[~is_supported]).any(dim=-1).all()
    assert (everywhere != a).any(dim=-1).all()


@pytest.mark.parametrize(
    ("full", "none"),
    [
        (math.nan, 0.0),
        (0.0, math.nan),
        (math.nan, math.nan),
        (1.0, 0.0),
        (0.0, math.inf),
        (-math.inf, 0.0),
        (math.inf, 0.0),
        (-math.inf, math.inf),
        (-math.inf, -math.inf),
        (0.0, 1e300),
    ],
)
def test_log_densities_that_bound_no_pull_are_an_error(full: float, none: float) -> None:
    rule = "log_full_pull and log_no_pull must both be inf, or finite with log_full_pull <= log_no_pull, got"
    with pytest.raises(ValueError, match=rule):
        PotentialField(torch.zeros(1, 2), 1.0, log_full_pull=full, log_no_pull=none)


def test_an_extension_of_another_version_is_not_used() -> None:
    program = """
import sys, types
import torch
sys.modules["lerobot_pf2mp.density._kernel_tree"] = types.ModuleType("_kernel_tree")
from lerobot_pf2mp.density import kernel_tree
from lerobot_pf2mp.potential_field import PotentialField
assert not kernel_tree.is_available()
print(PotentialField(torch.zeros(1, 2), 1.0).step_to_safety(torch.ones(2), 0.5, 0.0).tolist())
"""
    finished = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert finished.stdout == "[-0.5, -0.5]\n", finished.stderr
