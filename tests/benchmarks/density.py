# SPDX-License-Identifier: Apache-2.0
"""The density engine: log density and score of a potential field, beside what else computes them."""

from __future__ import annotations

import math
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from harness import Row, growth_exponent, ratio, synchronise, threads, time_in_turns

from lerobot_pf2mp.potential_field import PotentialField, fit

PART = "density"
OURS = "ours"
DIMS = (2, 3, 9, 32)
N_ANCHORS = (3_000, 100_000, 1_000_000)
N_QUERIES = (80, 10_000, 1_000_000)
PAPER = (2, 3_000, 80)  # the field of a maze, and one chunk

LARGEST_ERROR = 1e-4  # relative; what errs more does not count as exact
SECONDS = 0.6  # a call that would take longer is timed with fewer queries, in proportion to which the time then grows
TOO_LONG = 1.5  # what takes longer with the fewest queries has no turns
N_TRIED = (80, 1_000, 10_000, 100_000, 1_000_000)
PAIRS_PER_BLOCK = 2**24  # of the peers that hold all pairs of a block
N_CHECKED = 80
N_ROUNDS = 5

type Density = Callable[[torch.Tensor], tuple[torch.Tensor | None, torch.Tensor | None]]


@dataclass(frozen=True)
class Case:
    """Anchors and queries.

    Args:
        anchors: ``(M, D)``, along smooth paths.
        queries: ``(Q, D)``, one bandwidth away from such points.
        bandwidth: The most likely one for the anchors.
    """

    anchors: torch.Tensor
    queries: torch.Tensor
    bandwidth: float

    def __str__(self) -> str:
        n_anchors, dim = self.anchors.shape
        return f"D = {dim}, {n_anchors:.0e} anchors, {len(self.queries):.0e} queries".replace("e+0", "e")


def measure() -> Iterator[Row]:
    """Every cell, the growth with anchors and queries, and the memory."""
    devices = [("cpu", 1), ("cpu", 2)] + ([("cuda", 0)] if torch.cuda.is_available() else [])
    for device, n_threads in devices:
        with threads(n_threads or 1):
            for dim in DIMS:
                cells = [(m, q) for m in N_ANCHORS for q in N_QUERIES]
                if n_threads == 2:  # the sizes of the paper only: the rest takes an hour
                    cells = [(m, q) for m, q in cells if m == PAPER[1] and q < 1_000_000]
                for n_anchors, n_queries in cells:
                    yield from _measure_cell(make_case(dim, n_anchors, n_queries, device), n_threads)
    yield from _measure_growth()
    yield from _measure_memory()


def make_case(dim: int, n_anchors: int, n_queries: int, device: str = "cpu") -> Case:
    """Anchors along 1000 quadratic Bezier curves in the cube [-1, 1]^D, and queries near them."""
    generator = torch.Generator().manual_seed(0)
    corners = torch.rand(1000, 3, dim, generator=generator) * 2 - 1

    def along(n: int) -> torch.Tensor:
        a, b, c = corners[torch.randint(len(corners), (n,), generator=generator)].unbind(1)
        t = torch.rand(n, 1, generator=generator)
        return (1 - t) ** 2 * a + 2 * t * (1 - t) * b + t**2 * c

    anchors = along(n_anchors)
    bandwidth = fit(anchors[:3000]).bandwidth
    queries = along(n_queries) + bandwidth * torch.randn(n_queries, dim, generator=generator)
    return Case(anchors.to(device), queries.to(device), bandwidth)


def _measure_cell(case: Case, n_threads: int) -> Iterator[Row]:
    def row(
        quantity: str, value: float, unit: str, target: float | None = None, at_least: bool = False
    ) -> Row:
        return Row(PART, str(case), quantity, value, unit, n_threads, target, at_least)

    n_queries = len(case.queries)
    wanted = _in_double(Case(case.anchors, case.queries[:N_CHECKED], case.bandwidth))
    timed: dict[str, tuple[Density, int]] = {}
    for name, make in PEERS.items():
        density = make(case)
        if density is None:
            continue
        error = _error(density(case.queries[:N_CHECKED]), wanted)
        if name == OURS:
            yield row("error of the score", error, "relative", LARGEST_ERROR)
        elif error > LARGEST_ERROR:
            yield row(f"error of {name}, left out", error, "relative")
            continue
        n_timed, seconds = _queries_within(SECONDS, density, case)
        if seconds > TOO_LONG:
            yield row(f"{name}, {_from(n_timed)}, once", 1000 * seconds * n_queries / n_timed, "ms")
        else:
            timed[name] = density, n_timed
    calls = {name: partial(density, case.queries[:n]) for name, (density, n) in timed.items()}
    times = {
        name: [x * n_queries / timed[name][1] for x in seconds]
        for name, seconds in time_in_turns(calls, N_ROUNDS).items()
    }
    for name, seconds in times.items():
        n_timed = timed[name][1]
        quantity = name if n_timed == n_queries else f"{name}, {_from(n_timed)}"
        yield row(quantity, 1000 * median(seconds), "ms")
    peers = [name for name in times if name != OURS]
    if peers:
        fastest = min(peers, key=lambda name: median(times[name]))
        yield row(f"{OURS} / {fastest}, the fastest exact peer", ratio(times, OURS, fastest), "x", 1.1)
    if (case.anchors.shape[1], len(case.anchors), n_queries) == PAPER:
        for name in ("scikit-learn", "torch-kde"):
            if name in times:
                yield row(f"{name} / {OURS}", ratio(times, name, OURS), "x", 10.0, at_least=True)


def _queries_within(seconds: float, density: Density, case: Case) -> tuple[int, float]:
    """How many of the queries a call can have in that time, at least the fewest, and how long it then took [s]."""
    sizes = [n for n in N_TRIED if n <= len(case.queries)]
    for n, larger in zip(sizes, [*sizes[1:], None], strict=True):
        taken = _seconds(partial(density, case.queries[:n]), n_warm_up=0)
        if larger is None or taken * larger / n > seconds:
            return n, taken
    raise AssertionError  # the last size has no larger one


def _from(n_queries: int) -> str:
    return f"from {n_queries:.0e} queries".replace("e+0", "e")


def _measure_growth() -> Iterator[Row]:
    """Exponents of time against anchors and against queries, near the largest sizes."""
    with threads(1):
        for dim in DIMS[:3]:
            for what, sizes in (
                ("anchors", [(n, 10_000) for n in (30_000, 100_000, 300_000, 1_000_000)]),
                ("queries", [(100_000, n) for n in (3_000, 10_000, 30_000, 100_000)]),
            ):
                seconds = []
                for n_anchors, n_queries in sizes:
                    case = make_case(dim, n_anchors, n_queries)
                    density = _ours(case)
                    density(case.queries[:1000])
                    seconds.append(
                        median(_seconds(partial(density, case.queries), n_warm_up=0) for _ in range(3))
                    )
                swept = [size[what == "queries"] for size in sizes]
                value = growth_exponent(swept, seconds)
                yield Row(PART, f"D = {dim}, {_range(swept)} {what}", "exponent of time", value, "")


def _measure_memory() -> Iterator[Row]:
    """How far the peak of memory is above what was held before the field was made; where Linux and glibc help."""
    if platform.libc_ver()[0] != "glibc":
        return
    code = """
import ctypes, sys
from pathlib import Path
sys.path.insert(0, sys.argv[3])
from density import _ours, make_case
def held(what): return int(Path("/proc/self/status").read_text().split(what + ":")[1].split()[0]) / 1024  # [MB]
small = make_case(3, 300, 100)
_ours(small)(small.queries)
case = make_case(3, int(sys.argv[1]), int(sys.argv[2]))
ctypes.CDLL(None).malloc_trim(0)  # gives free memory back, in which the call would find room
Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
before = held("VmRSS")
_ours(case)(case.queries)
print(held("VmHWM") - before)
"""
    for what, sizes in (
        ("anchors", [(n, 1_000) for n in (100_000, 300_000, 1_000_000)]),
        ("queries", [(3_000, n) for n in (100_000, 300_000, 1_000_000)]),
    ):
        used = []
        for n_anchors, n_queries in sizes:
            command = [sys.executable, "-c", code, str(n_anchors), str(n_queries), str(Path(__file__).parent)]
            used.append(float(subprocess.run(command, capture_output=True, text=True, check=True).stdout))
            pairs = n_anchors * n_queries * 4 / 2**20
            label = f"D = 3, {n_anchors:.0e} anchors, {n_queries:.0e} queries".replace("e+0", "e")
            yield Row(PART, label, f"memory of field and call (all pairs: {pairs:,.0f} MB)", used[-1], "MB")
        swept = [size[what == "queries"] for size in sizes]
        value = growth_exponent(swept, used)
        yield Row(PART, f"D = 3, {_range(swept)} {what}", "exponent of memory", value, "", target=1.2)


def _range(sizes: list[int]) -> str:
    return f"{min(sizes):.0e} to {max(sizes):.0e}".replace("e+0", "e")


def _ours(case: Case) -> Density:
    field = PotentialField(case.anchors, case.bandwidth)

    def density(queries: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        log_density, shift = field.log_density_and_mean_shift(queries)
        return log_density, shift / case.bandwidth**2

    return density


def _plain_torch(case: Case) -> Density:
    """cdist, logsumexp and autograd."""
    normaliser = _log_normaliser(case)

    def density(queries: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        log_densities, scores = [], []
        for block in queries.split(max(1, PAIRS_PER_BLOCK // len(case.anchors))):
            block = block.detach().requires_grad_()
            squares = torch.cdist(block, case.anchors).square()
            log_density = torch.logsumexp(-squares / (2 * case.bandwidth**2), dim=1) - normaliser
            (score,) = torch.autograd.grad(log_density.sum(), block)
            log_densities.append(log_density.detach())
            scores.append(score)
        return torch.cat(log_densities), torch.cat(scores)

    return density


def _attention(case: Case) -> Density:
    """The score alone, by PyTorch's scaled dot-product attention; anchors are centred and prepared beforehand."""
    centre = case.anchors.mean(dim=0)
    anchors = case.anchors - centre
    bias = -0.5 * (anchors / case.bandwidth).square().sum(dim=1, keepdim=True)
    keys = torch.cat([anchors / case.bandwidth, bias], dim=1)[None, None]
    values = torch.cat([anchors, torch.zeros_like(bias)], dim=1)[None, None]

    def density(queries: torch.Tensor) -> tuple[None, torch.Tensor]:
        centred = queries - centre
        ones = torch.ones_like(centred[:, :1])
        scaled = torch.cat([centred / case.bandwidth, ones], dim=1)[None, None]
        means = F.scaled_dot_product_attention(scaled, keys, values, scale=1.0)[0, 0, :, :-1]
        return None, (means - centred) / case.bandwidth**2

    return density


def _pykeops(case: Case) -> Density | None:
    if shutil.which("g++") is None:  # with which it compiles
        return None
    try:
        from pykeops.torch import LazyTensor
    except ImportError:
        return None
    normaliser = _log_normaliser(case)
    anchors = LazyTensor((case.anchors / case.bandwidth)[None])
    values = LazyTensor(case.anchors[None])

    def density(queries: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        exponents = -((LazyTensor((queries / case.bandwidth)[:, None]) - anchors) ** 2).sum(-1) / 2
        means = exponents.sumsoftmaxweight(values, dim=1)
        log_sums = exponents.logsumexp(dim=1).squeeze(-1)
        return log_sums - normaliser, (means - queries) / case.bandwidth**2

    return density


def _scikit_learn(case: Case) -> Density | None:
    """The log density alone, which is all that it has."""
    if case.anchors.is_cuda:
        return None
    from sklearn.neighbors import KernelDensity

    kde = KernelDensity(bandwidth=case.bandwidth).fit(case.anchors.numpy())

    def density(queries: torch.Tensor) -> tuple[torch.Tensor, None]:
        return torch.from_numpy(kde.score_samples(queries.numpy())), None

    return density


def _scipy(case: Case) -> Density | None:
    """The log density alone, which is all that it has; its kernels' covariance is set to the same ones."""
    if case.anchors.is_cuda:
        return None
    from scipy.stats import gaussian_kde

    class Isotropic(gaussian_kde):
        def _compute_covariance(self) -> None:
            self.factor = case.bandwidth
            self.cho_cov = case.bandwidth * np.eye(self.d)
            self.covariance = case.bandwidth**2 * np.eye(self.d)
            self.log_det = 2 * np.log(np.diag(self.cho_cov * math.sqrt(2 * math.pi))).sum()

    kde = Isotropic(case.anchors.numpy().T.astype(np.float64))

    def density(queries: torch.Tensor) -> tuple[torch.Tensor, None]:
        return torch.from_numpy(kde.logpdf(queries.numpy().T.astype(np.float64))), None

    return density


def _torch_kde(case: Case) -> Density | None:
    """The log density, and its score by autograd."""
    try:
        from torchkde import KernelDensity
    except ImportError:
        return None
    kde = KernelDensity(bandwidth=case.bandwidth).fit(case.anchors)
    n_at_once = max(1, PAIRS_PER_BLOCK // case.anchors.numel())

    def density(queries: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        log_densities, scores = [], []
        for block in queries.split(n_at_once):
            block = block.detach().requires_grad_()
            log_density = kde.score_samples(block, batch_size=n_at_once)
            (score,) = torch.autograd.grad(log_density.sum(), block)
            log_densities.append(log_density.detach())
            scores.append(score)
        return torch.cat(log_densities), torch.cat(scores)

    return density


PEERS: dict[str, Callable[[Case], Any]] = {
    OURS: _ours,
    "torch (cdist, logsumexp, autograd)": _plain_torch,
    "attention (score alone)": _attention,
    "pykeops": _pykeops,
    "scikit-learn": _scikit_learn,
    "scipy": _scipy,
    "torch-kde": _torch_kde,
}


def _log_normaliser(case: Case) -> float:
    n_anchors, dim = case.anchors.shape
    return math.log(n_anchors) + dim * math.log(case.bandwidth * math.sqrt(2 * math.pi))


def _in_double(case: Case) -> tuple[torch.Tensor, torch.Tensor]:
    """Brute force in float64 on the CPU."""
    anchors, log_densities, scores = case.anchors.cpu().double(), [], []
    for query in case.queries.cpu().double():
        exponents = -(query - anchors).square().sum(dim=1) / (2 * case.bandwidth**2)
        log_densities.append(exponents.logsumexp(dim=0) - _log_normaliser(case))
        scores.append((torch.softmax(exponents, dim=0) @ anchors - query) / case.bandwidth**2)
    return torch.stack(log_densities), torch.stack(scores)


def _error(
    found: tuple[torch.Tensor | None, torch.Tensor | None], wanted: tuple[torch.Tensor, torch.Tensor]
) -> float:
    """The largest error of the score relative to the scores' root mean square; without one, of the log density [nats]."""
    log_density, score = found
    if score is not None:
        scale = wanted[1].square().sum(dim=1).mean().sqrt()
        return float((score.cpu().double() - wanted[1]).norm(dim=1).max() / scale)
    assert log_density is not None
    return float((log_density.cpu().double() - wanted[0]).abs().max())


def _seconds(call: Callable[[], object], n_warm_up: int = 1) -> float:
    for _ in range(n_warm_up):
        call()
    synchronise()
    start = time.perf_counter()
    call()
    synchronise()
    return time.perf_counter() - start
