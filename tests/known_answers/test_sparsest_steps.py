"""Guards sparsest controls with bounded steps against mixed-integer programs that are made here."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.optimize import Bounds, LinearConstraint, milp

import sparserob_core as sr
from tests.support.draws import taken

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Reach:
    """A random problem that ends in a box: ``x' = A x + B u + w``, ``lower <= u <= upper`` around 0, steps of at most
    ``step``, ``w`` in an ellipsoid of ``shape``, constant on every piece."""

    A: Array
    B: Array
    breakpoints: Array
    start: Array
    lower: Array
    upper: Array
    step: Array
    before: Array | None
    shape: Array
    least: Array
    most: Array

    @property
    def pieces(self) -> int:
        return self.breakpoints.size - 1

    def pushes(self) -> Array:
        """What a push on each piece gives to the final state, ``(K, n, n)``."""
        return pushes(self.A, self.breakpoints)

    def config(self, method: str) -> dict[str, Any]:
        problem: dict[str, Any] = {
            "name": "linear",
            "system": {"A": self.A.tolist(), "B": self.B.tolist()},
            "horizon": float(self.breakpoints[-1]),
            "initial_state": self.start.tolist(),
            "control": {"box": {"lower": self.lower.tolist(), "upper": self.upper.tolist()}},
            "control_step": {"box": self.step.tolist()},
            "disturbance": {"ellipsoid": {"shape": self.shape.tolist()}},
            "terminal": [{"box": {"lower": self.least.tolist(), "upper": self.most.tolist()}}],
        }
        if self.before is not None:
            problem["initial_control"] = self.before.tolist()
        control = {"name": "piecewise_constant", "breakpoints": self.breakpoints.tolist()}
        return {"problem": problem, "dictionaries": {"control": control}, "method": {"name": method}}

    def fewest(self) -> float:
        """The least time of action, by a mixed-integer program of the exact worst cases."""
        n, m = self.B.shape
        K, gives = self.pieces, self.pushes()
        size, lengths = m * K, np.diff(self.breakpoints)
        rows = np.einsum("kij,jc->ick", gives, self.B).reshape(n, size)
        pushed = np.sqrt(np.einsum("kij,jl,kil->ki", gives, self.shape, gives)).sum(axis=0)
        free = expm(self.A * self.breakpoints[-1]) @ self.start
        values, acts = np.eye(size), np.eye(size)
        low, high = np.repeat(self.lower, K), np.repeat(self.upper, K)
        differences = np.eye(K) - np.eye(K, k=-1)
        middle = np.zeros((m, K)) if self.before is None else np.outer(self.before, np.eye(K)[0])
        kept = np.ones((m, K), dtype=bool)
        kept[:, 0] = self.before is not None
        steps, most = np.kron(np.eye(m), differences)[kept.ravel()], np.repeat(self.step, K)[kept.ravel()]
        none = np.zeros((steps.shape[0], size))
        around = middle.ravel()[kept.ravel()]
        found = milp(
            np.concatenate([np.zeros(size), np.tile(lengths, m)]),
            constraints=[
                LinearConstraint(np.hstack([values, -acts * high]), -np.inf, 0.0),
                LinearConstraint(np.hstack([values, -acts * low]), 0.0, np.inf),
                LinearConstraint(np.hstack([steps, none]), around - most, around + most),
                LinearConstraint(
                    np.hstack([rows, np.zeros((n, size))]), self.least - free + pushed, self.most - free - pushed
                ),
            ],
            integrality=np.repeat([0, 1], size),
            bounds=Bounds(np.repeat([-np.inf, 0.0], size), np.repeat([np.inf, 1.0], size)),
        )
        assert found.x is not None
        return float(found.fun)


def pushes(A: Array, breakpoints: Array) -> Array:
    n = A.shape[0]
    both = np.block([[A, np.eye(n)], [np.zeros((n, 2 * n))]])
    ends = [expm(both * (breakpoints[-1] - t))[:n, n:] for t in breakpoints]
    return np.array([before - after for before, after in pairwise(ends)])


def reach(seed: int) -> Reach:
    """A problem that a control can do which acts on few pieces, with little to spare."""
    rng = np.random.default_rng(seed)
    n, m, K = int(rng.integers(1, 4)), int(rng.integers(1, 3)), int(rng.integers(5, 10))
    A, B = 0.6 * rng.normal(size=(n, n)) - 0.3 * np.eye(n), rng.normal(size=(n, m))
    inner = np.sort(rng.uniform(0.05, 0.95, K - 1)) if rng.random() < 0.5 else np.arange(1, K) / K
    breakpoints = rng.uniform(1.0, 4.0) * np.concatenate([[0.0], inner, [1.0]])
    lower, upper = -rng.uniform(0.2, 1.5, m), rng.uniform(0.2, 1.5, m)
    step = rng.uniform(0.3, 1.2, m)
    root = 0.02 * rng.normal(size=(n, n))
    shape, gives = root @ root.T + 1e-5 * np.eye(n), pushes(A, breakpoints)
    before = 0.3 * lower * rng.uniform(size=m) if rng.random() < 0.5 else None
    u = np.zeros((m, K))
    for channel in u:
        first = int(rng.integers(0, K))
        channel[first : first + 2] = 1.0
    u *= (lower + (upper - lower) * rng.uniform(size=m))[:, None]
    last = u[:, 0] if before is None else before
    for k in range(K):
        u[:, k] = last = np.clip(u[:, k], last - step, last + step)
    start = rng.normal(size=n)
    middle = expm(A * breakpoints[-1]) @ start + np.einsum("kij,jc,ck->i", gives, B, u)
    room = np.sqrt(np.einsum("kij,jl,kil->ki", gives, shape, gives)).sum(axis=0) + rng.uniform(0.0005, 0.05, n)
    return Reach(A, B, breakpoints, start, lower, upper, step, before, shape, middle - room, middle + room)


def agrees(seed: int, where: Path) -> None:
    problem = reach(seed)
    truth = problem.fewest()
    outcome = sr.run(problem.config("sparsest"), out=where, quiet=True, figures=False)
    assert outcome.status == "certified"
    assert outcome.result.cost == pytest.approx(truth, rel=1e-6, abs=1e-9)
    assert outcome.result.lower_bound == pytest.approx(truth, rel=1e-6, abs=1e-9)
    assert outcome.control is not None
    off = outcome.control == 0.0
    assert np.diff(problem.breakpoints) @ (~off).sum(axis=0) == pytest.approx(truth, rel=1e-6, abs=1e-9)
    assert sr.check(where).status == "verified"


@pytest.mark.first(1)
@pytest.mark.parametrize("seed", [2, 6])
def test_what_is_off_is_0_and_the_leaves_prove_what_is_written(seed: int, tmp_path: Path) -> None:
    agrees(seed, tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(taken(40)))
def test_random_problems_with_steps_agree_with_mixed_integer_programs(seed: int, tmp_path: Path) -> None:
    agrees(seed, tmp_path / "run")


@pytest.mark.first(1)
@pytest.mark.parametrize("seed", [3, 13, 19, 22])
def test_an_exchange_leaves_no_dust_with_steps(seed: int, tmp_path: Path) -> None:
    """Values far below what a channel can be are 0, so that the interval of the time of action speaks of them."""
    outcome = sr.run(reach(seed).config("exchange"), out=tmp_path / "run", quiet=True, figures=False)
    assert outcome.status == "certified"
    assert outcome.control is not None
    small = np.abs(outcome.control) < 1e-6
    assert not outcome.control[small].any()
    acting = outcome.summary["sparsity"]
    assert acting["fewest_active"]["upper"] <= acting["active_fraction"] * (1.0 + 1e-9)
