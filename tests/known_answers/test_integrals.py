"""Guards integrals that are bounded, beside independent linear programs, in which ``int x`` is what the differential
equation says of it, ``A^-1 (x(b) - x(a) - B int u - E int w)``, and nothing is accumulated."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.experiment.check.check import check

Rows = list[tuple[list[float], list[float], float, float, float, float]]


@dataclass(frozen=True)
class Plan:
    """``x' = A x + B u + E w + c`` on equal pieces, ``least <= u <= most``, ``|w| <= noise``; path bounds
    ``(state, low, high, from, to)``, terminal half-widths, and integrals ``(h, g, from, to, low, high)``."""

    A: np.ndarray
    B: np.ndarray
    E: np.ndarray
    start: np.ndarray
    horizon: float
    pieces: int
    least: np.ndarray
    most: np.ndarray
    weights: np.ndarray
    noise: np.ndarray
    path: list[tuple[int, float, float, float, float]]
    ends: np.ndarray
    integrals: Rows = field(default_factory=list)
    delay: float = 0.0
    begun: np.ndarray | None = None

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What the initial state ``(d, d)``, the controls ``(d, m K)`` and the disturbances ``(d, w K)`` make of the
        state at a time; the controls act later by the delay, the first piece of them at once is 0 until then."""
        d, K, step = len(self.A), self.pieces, self.horizon / self.pieces
        known: dict[tuple[bytes, float], np.ndarray] = {}

        def flow(matrix: np.ndarray, length: float) -> np.ndarray:
            key = matrix.tobytes(), round(length, 12)
            if key not in known:
                known[key] = expm(matrix * length)
            return known[key]

        def driven(matrix: np.ndarray, late: float) -> np.ndarray:
            n = matrix.shape[1]
            found = np.zeros((d, n * K))
            for k in range(K):
                begin, end = min(k * step + late, time), min((k + 1) * step + late, time)
                if end > begin:
                    both = np.block([[self.A, matrix], [np.zeros((n, d + n))]])
                    found[:, k::K] = flow(self.A, time - end) @ flow(both, end - begin)[:d, d:]
            return found

        return flow(self.A, time), driven(self.B, self.delay), driven(self.E, 0.0)

    def overlaps(self, begin: float, end: float, late: float = 0.0) -> np.ndarray:
        """How long each piece acts within a window, ``(K,)``."""
        edges = np.linspace(0.0, self.horizon, self.pieces + 1) + late
        return np.maximum(0.0, np.minimum(edges[1:], end) - np.maximum(edges[:-1], begin))

    def integral(self, h: np.ndarray, g: np.ndarray, begin: float, end: float) -> tuple[np.ndarray, ...]:
        """``int h'x + g'u`` as weights of the initial state, the commanded controls and the disturbances."""
        first, last = self.at(begin), self.at(end)
        rows = h @ np.linalg.inv(self.A)
        acting, blown = self.overlaps(begin, end, self.delay), self.overlaps(begin, end)
        started, driven, pushed = (rows @ (b - a) for a, b in zip(first, last, strict=True))
        driven = driven - np.kron(rows @ self.B, acting) + np.kron(g, blown)
        return started, driven, pushed - np.kron(rows @ self.E, blown)

    def value(self, between: int = 6) -> float:
        """The least cost, with the path at so many times in every piece, which is a little low."""
        K, step = self.pieces, self.horizon / self.pieces
        G, h = [], []

        def bound(weights: tuple[np.ndarray, ...], low: float, high: float) -> None:
            started, driven, pushed = weights
            spread = np.abs(pushed) @ np.repeat(self.noise, K)
            spread += 0.0 if self.begun is None else np.abs(started) @ self.begun
            for sign, side in ((1.0, high), (-1.0, -low)):
                if np.isfinite(side):
                    G.append(sign * driven)
                    h.append(side - spread - sign * started @ self.start)

        for state, low, high, begin, end in self.path:
            times = np.union1d(np.arange(K * between + 1) * step / between, [begin, end])
            for time in times[(times >= begin - 1e-12) & (times <= end + 1e-12)]:
                bound(tuple(part[state] for part in self.at(time)), low, high)
        for state, width in enumerate(self.ends):
            bound(tuple(part[state] for part in self.at(self.horizon)), -width, width)
        for row, gain, begin, end, low, high in self.integrals:
            bound(self.integral(np.array(row), np.array(gain), begin, end), low, high)
        m = len(self.least)
        cost = np.repeat(self.weights, K) * step
        sides = [
            (min(0.0, a), max(0.0, b)) for a, b in zip(np.repeat(self.least, K), np.repeat(self.most, K), strict=True)
        ]
        parts = [(0.0, high) for _, high in sides] + [(0.0, -low) for low, _ in sides]
        both = np.hstack([np.array(G), -np.array(G)])
        found = linprog(np.tile(cost, 2), A_ub=both, b_ub=np.array(h), bounds=parts, method="highs")
        assert m and found.status in (0, 2)
        return float(found.fun) if found.status == 0 else np.inf

    def problem(self) -> sr.OptimalControlProblem:
        """The same for the package."""
        free = np.full(len(self.A), np.inf)
        path = []
        for state, low, high, begin, end in self.path:
            lower, upper = -free, free.copy()
            lower[state], upper[state] = low, high
            path.append(sr.PathConstraint(sr.Box(lower, upper), begin, end))
        return sr.OptimalControlProblem(
            system=sr.LinearSystem(self.A, self.B, self.E, delay=self.delay),
            horizon=self.horizon,
            initial_state=self.start,
            initial_set=None if self.begun is None else sr.Box(-self.begun, self.begun),
            control=sr.Box(self.least, self.most),
            weights=self.weights,
            disturbance=sr.Box(-self.noise, self.noise),
            path=path,
            terminal=[sr.Box(-self.ends, self.ends)] if np.isfinite(self.ends).any() else [],
            initial_control=np.zeros(len(self.least)) if self.delay else None,
            integral=[
                sr.IntegralConstraint(
                    H=[h] if any(h) else None, G=[g] if any(g) else None, start=begin, stop=end, lower=low, upper=high
                )
                for h, g, begin, end, low, high in self.integrals
            ],
        )


def spring(**more: object) -> Plan:
    plan = Plan(
        A=np.array([[0.0, 1.0], [-2.0, -0.5]]),
        B=np.array([[0.0], [1.0]]),
        E=np.eye(2),
        start=np.array([-1.0, 1.0]),
        horizon=5.0,
        pieces=20,
        least=-np.ones(1),
        most=np.ones(1),
        weights=np.ones(1),
        noise=np.full(2, 0.03),
        path=[(1, -1.5, 1.5, 0.5, 5.0)],
        ends=np.full(2, 0.3),
    )
    return replace(plan, **more)  # type: ignore[arg-type]


def house() -> Plan:
    """`configs/energy_budget.yaml`."""
    return Plan(
        A=np.array([[-0.5, 0.4], [0.1, -0.15]]),
        B=np.array([[0.8, 0.6], [0.0, 0.0]]),
        E=np.array([[1.0], [0.0]]),
        start=np.array([8.0, 7.0]),
        horizon=24.0,
        pieces=48,
        least=np.zeros(2),
        most=np.array([3.0, 4.0]),
        weights=np.array([1.0, 3.0]),
        noise=np.array([0.1]),
        path=[(0, 8.0, 14.0, 7.0, 21.0)],
        ends=np.full(2, np.inf),
        integrals=[
            ([1.0, 0.0], [0.0, 0.0], 8.0, 18.0, 105.0, np.inf),
            ([0.0, 0.0], [1.0, 0.0], 16.0, 20.0, -np.inf, 2.0),
        ],
    )


INFINITE = np.inf
BOUND: dict[str, dict[str, object]] = {
    "state": {"integrals": [([1.0, 0.0], [0.0], 0.6, 2.6, 1.0, INFINITE)]},
    "state from the beginning": {"integrals": [([1.0, 0.0], [0.0], 0.0, 2.6, -INFINITE, -0.1)]},
    "control": {"integrals": [([0.0, 0.0], [1.0], 0.9, 3.1, -INFINITE, -0.3)]},
    "both": {"integrals": [([1.0, 0.0], [0.5], 0.6, 2.65, 1.0, INFINITE)]},
    "initial set": {
        "integrals": [([1.0, 0.0], [0.5], 0.6, 2.65, 1.0, INFINITE)],
        "begun": np.array([0.02, 0.03]),
    },
    "delay": {"integrals": [([1.0, 0.0], [0.5], 0.6, 2.65, 1.0, INFINITE)], "delay": 0.3},
    "delayed control": {"integrals": [([0.0, 0.0], [1.0], 0.9, 3.1, -INFINITE, -0.3)], "delay": 0.3},
    "two": {
        "integrals": [
            ([1.0, 0.0], [0.0], 0.6, 2.6, -INFINITE, 0.6),
            ([0.0, 0.0], [1.0], 0.9, 3.1, -0.35, INFINITE),
        ]
    },
}


@pytest.mark.first(4)
@pytest.mark.parametrize("name", BOUND)
def test_an_integral_that_binds_costs_what_an_independent_program_says(name: str) -> None:
    plan = spring(path=[], **BOUND[name])
    value = plan.value()
    result = sr.solve(plan.problem(), control={"name": "piecewise_constant", "pieces": plan.pieces})
    free = replace(plan, integrals=[]).value()
    assert value > free + 1e-3  # it binds
    assert result.status == "certified"
    assert result.cost == pytest.approx(value, rel=1e-7)


def test_a_battery_and_degree_hours_cost_what_an_independent_program_says() -> None:
    assert house().value(1) == pytest.approx(82.7081503, rel=1e-8)  # what tests/rules/test_configs.py expects


def test_every_signal_moves_an_integral_within_its_worst_case_and_one_attains_it() -> None:
    plan = spring(path=[], **BOUND["both"])
    result = sr.solve(plan.problem(), control={"name": "piecewise_constant", "pieces": plan.pieces})
    (row, gain, begin, end, least, _), K = plan.integrals[0], plan.pieces
    started, driven, pushed = plan.integral(np.array(row), np.array(gain), begin, end)
    still = float(started @ plan.start + driven @ result.control.values.ravel())
    noise = np.repeat(plan.noise, K)
    worst = still - float(np.abs(pushed) @ noise)
    assert worst == pytest.approx(least, abs=1e-7)
    rng = np.random.default_rng(1)
    signals = rng.choice([-1.0, 1.0], size=(200, noise.size)) * noise
    assert (still + signals @ pushed >= least - 1e-7).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["both", "delay", "initial set", "two"])
def test_check_derives_the_integrals_on_its_own(name: str, tmp_path: Path) -> None:
    plan = spring(path=[], **BOUND[name])
    result = sr.solve(plan.problem(), control={"name": "piecewise_constant", "pieces": plan.pieces})
    result.save(tmp_path / "run", figures=False)
    assert check(tmp_path / "run").status == "verified"


def test_an_answering_control_needs_no_more_than_one_that_does_not() -> None:
    plan = spring(path=[], pieces=8, integrals=[([1.0, 0.0], [0.5], 0.6, 2.65, 0.9, INFINITE)])
    grid = {"name": "piecewise_constant", "pieces": plan.pieces}
    alone, answering = (sr.solve(plan.problem(), control=grid, policy=policy) for policy in ("open_loop", "affine"))
    assert alone.status == answering.status == "certified"
    assert answering.cost < alone.cost - 1e-3
