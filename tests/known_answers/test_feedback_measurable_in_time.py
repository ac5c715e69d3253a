"""Guards measurable disturbances under policy affine of plants that change with time: independent linear programs, the
constant plant, other units, loops that an integrator drives, forged certificates, a rendezvous about an ellipse."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import linprog
from scipy.sparse import coo_array

from sparserob_core.experiment.check.check import check
from tests.known_answers.test_feedback_measurable import FORGERIES, proven, run

Problem = dict[str, Any]
FADING: Problem = {  # x = (1 + s) / (1 + t) from s to t
    "name": "linear",
    "system": {"A": [["-1/(1 + t)"]], "B": [[1]], "E": [["cos(3*t)"]]},
    "horizon": 3.0,
    "initial_state": [2.0],
    "control": {"box": 1.5},
    "disturbance": {"box": 0.3},
    "disturbance_class": "measurable",
    "path": [{"box": [1.0], "from": 1.5}],
    "terminal": [{"box": [0.3]}],
}
TURNING: Problem = {  # by the angle t^2 / 2
    "name": "linear",
    "system": {"A": [[0, "t"], ["-t", 0]], "B": [[0], [1]], "E": [["0.5*cos(t)", 0], [0, 1]]},
    "horizon": 2.0,
    "initial_state": [-1.0, 0.6],
    "control": {"box": 1.0},
    "disturbance": {"polytope": {"H": [[-1, 0], [0, -1], [1, 1]], "h": [0.08, 0.1, 0.15]}},
    "disturbance_class": "measurable",
    "path": [{"box": [0.7, None], "from": 0.9}],
    "terminal": [{"box": [0.55, 0.55]}],
}


def pieces(count: int) -> Problem:
    return {"dictionaries": {"control": {"name": "piecewise_constant", "pieces": count}}}


class Independent:
    """The least peaks by a linear program: rows ``c'x(t) <= wall`` at times, disturbances between ``corners`` that are
    constant on ``fine`` parts of every piece, and on a hundred of the piece under way. ``onward (t, s)``: the
    transitions ``(n, d, d)`` from times ``s (n,)`` to ``t``; ``E (n, d, mw)`` at times."""

    def __init__(
        self,
        problem: Problem,
        count: int,
        onward: Callable[[float, np.ndarray], np.ndarray],
        E: Callable[[np.ndarray], np.ndarray],
        corners: np.ndarray,
        fine: int = 40,
    ) -> None:
        self.count, self.onward, self.E, self.corners, self.fine = count, onward, E, corners, fine
        self.ends, self.most = np.linspace(0.0, problem["horizon"], count + 1), problem["control"]["box"]
        self.start, self.B = np.array(problem["initial_state"]), np.array(problem["system"]["B"], dtype=float)
        self.d = self.start.size
        self.pushes = [self.integral(high, low, high, fine, E) for low, high in pairwise(self.ends)]
        # variables: v, peaks, gains of piece k on what piece j did; then bounds of support functions
        pairs = [(k, j) for k in range(count) for j in range(k)]
        self.gains = {pair: 2 * count + self.d * i for i, pair in enumerate(pairs)}
        self.size = 2 * count + self.d * len(pairs)
        self.entries: list[tuple[int, int, float]] = []
        self.limits: list[float] = []

    def integral(
        self, t: float, low: float, high: float, parts: int, of: Callable[[np.ndarray], np.ndarray]
    ) -> np.ndarray:
        """What ``of`` makes of the state at ``t`` on parts of an interval, ``(parts, d, n)``."""
        x, w = np.polynomial.legendre.leggauss(8)
        cuts = np.linspace(low, high, parts + 1)
        half = np.diff(cuts)[:, None] / 2
        s = (cuts[:-1, None] + half * (1 + x)).ravel()
        found = (self.onward(t, s) @ of(s)).reshape(parts, x.size, self.d, -1)
        return np.asarray(np.einsum("pq,pqdm->pdm", half * w, found))

    def add(self, terms: dict[int, float], limit: float) -> None:
        """A row."""
        self.entries += [(len(self.limits), column, value) for column, value in terms.items()]
        self.limits.append(limit)

    def supported(self, plain: np.ndarray, answers: dict[int, float], j: int) -> dict[int, float]:
        """Variables whose sum is at least the support function of what piece j does, along ``plain`` and gains."""
        named = range(self.size, self.size + self.fine)
        self.size += self.fine
        for z, push in zip(named, self.pushes[j], strict=True):
            for way in self.corners @ push.T:
                terms = {z: -1.0}
                for first, factor in answers.items():
                    terms |= {first + d: factor * float(way[d]) for d in range(self.d)}
                self.add(terms, -float(plain @ way))
        return dict.fromkeys(named, 1.0)

    def keep(self, c: list[float], wall: float, t: float) -> None:
        """``c'x(t) <= wall``."""
        row, p = np.array(c), max(int(np.searchsorted(self.ends, t)) - 1, 0)
        every = (self.integral(t, low, min(t, high), 1, self.pushed) for low, high in pairwise(self.ends[: p + 2]))
        moved = [float(row @ one[0, :, 0]) for one in every]
        terms = dict(enumerate(moved))
        for j in range(p):
            plain = row @ self.onward(t, self.ends[j + 1 : j + 2])[0]
            terms |= self.supported(plain, {self.gains[k, j]: moved[k] for k in range(j + 1, p + 1)}, j)
        heights = np.einsum("d,pdm,vm->pv", row, self.integral(t, self.ends[p], t, 100, self.E), self.corners)
        free = row @ self.onward(t, np.zeros(1))[0] @ self.start
        self.add(terms, wall - float(free) - float(heights.max(axis=1).sum()))

    def pushed(self, s: np.ndarray) -> np.ndarray:
        """``B`` at times."""
        return np.tile(self.B, (s.size, 1, 1))

    def solved(self) -> float:
        """The least sum of peaks times lengths."""
        count = self.count
        for k in range(count):
            for sign in (1.0, -1.0):
                terms = {k: sign, count + k: -1.0}
                for j in range(k):
                    terms |= self.supported(np.zeros(self.d), {self.gains[k, j]: sign}, j)
                self.add(terms, 0.0)
        rows, columns, values = zip(*self.entries, strict=True)
        table = coo_array((values, (rows, columns)), shape=(len(self.limits), self.size)).tocsr()
        prices = np.zeros(self.size)
        prices[count : 2 * count] = np.diff(self.ends)
        bounds = [(None, None)] * count + [(0.0, self.most)] * count + [(None, None)] * (self.size - 2 * count)
        return float(linprog(prices, A_ub=table, b_ub=self.limits, bounds=bounds, method="highs").fun)


@pytest.mark.slow
def test_a_state_that_fades_costs_what_an_independent_linear_program_says(tmp_path: Path) -> None:
    outcome = run(FADING, tmp_path / "run", "peak", **pieces(4))
    proven(outcome)
    program = Independent(
        FADING,
        4,
        lambda t, s: ((1.0 + s) / (1.0 + t))[:, None, None],
        lambda s: np.cos(3.0 * s)[:, None, None],
        np.array([[0.3], [-0.3]]),
    )
    for sign in (1.0, -1.0):
        program.keep([sign], 0.3, 3.0)
        for t in np.linspace(1.5, 3.0, 41):
            program.keep([sign], 1.0, float(t))
    said = program.solved()
    assert outcome.result.cost >= said * (1.0 - 1e-9)
    assert outcome.result.cost == pytest.approx(said, rel=1e-3)


def turned(t: float, s: np.ndarray) -> np.ndarray:
    angle = (t**2 - s**2) / 2
    return np.stack([np.stack([np.cos(angle), np.sin(angle)], 1), np.stack([-np.sin(angle), np.cos(angle)], 1)], 1)


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of what turns, in a triangle of disturbances, that is proven."""
    outcome = run(TURNING, tmp_path_factory.mktemp("turning") / "run", "peak", **pieces(3))
    proven(outcome)
    return outcome.directory


@pytest.mark.slow
def test_what_turns_costs_what_an_independent_linear_program_says(turning: Path) -> None:
    none = np.zeros_like
    program = Independent(
        TURNING,
        3,
        turned,
        lambda s: np.stack([np.stack([0.5 * np.cos(s), none(s)], 1), np.stack([none(s), 1.0 + none(s)], 1)], 1),
        np.array([[-0.08, -0.1], [-0.08, 0.23], [0.25, -0.1]]),
    )
    for sign in (1.0, -1.0):
        program.keep([sign, 0.0], 0.55, 2.0)
        program.keep([0.0, sign], 0.55, 2.0)
        for t in np.linspace(0.9, 2.0, 23):
            program.keep([sign, 0.0], 0.7, float(t))
    said = program.solved()
    cost = json.loads((turning / "result.json").read_text())["cost"]
    assert cost >= said * (1.0 - 1e-9)
    assert cost == pytest.approx(said, rel=2e-3)


@pytest.mark.slow
def test_no_signal_that_an_integrator_drives_the_plant_with_leaves_what_was_proven(turning: Path) -> None:
    """Corners that change at random times, and at those at which the run says that they are the worst."""
    data, rng = np.load(turning / "solution.npz"), np.random.default_rng(0)
    v, gains, ends = data["control"], data["gains"], data["breakpoints"]
    corners, middle = np.array([[-0.08, -0.1], [-0.08, 0.23], [0.25, -0.1]]), np.array([0.085, 0.065])
    worst = json.loads((turning / "certificate.json").read_text())["multipliers"]["constraints"]

    def moved(state: np.ndarray, low: float, high: float, u: float, w: np.ndarray, times: np.ndarray) -> Any:
        def slope(t: float, x: np.ndarray) -> list[float]:
            return [t * x[1] + 0.5 * np.cos(t) * w[0], -t * x[0] + u + w[1]]

        return solve_ivp(slope, (low, high), state, rtol=1e-10, atol=1e-12, t_eval=times).y

    for case in range(12):
        said = worst[case % len(worst)]
        changes, signal = np.array(said["changes"]), np.array(said["disturbance"]).T
        if case >= len(worst) or case % 3 == 2:
            changes = np.append(0.0, np.sort(rng.uniform(0.0, 2.0, 12)))
            signal = corners[rng.integers(0, 3, 13)]
        state, innovations = np.array([-1.0, 0.6]), [np.zeros(2)]
        for k, (a, b) in enumerate(pairwise(ends)):
            u = float(v[0, k] + sum(gains[k, j][0] @ innovations[j] for j in range(k + 1)))
            assert abs(u) <= 1.0 + 1e-9
            predicted = moved(state, a, b, u, middle, np.array([b]))[:, -1]
            cuts = np.unique([a, b, *changes[(changes > a) & (changes < b)]])
            for low, high in pairwise(cuts):
                w = signal[np.searchsorted(changes, (low + high) / 2) - 1]
                every = moved(state, low, high, u, w, np.linspace(low, high, 9))
                state = every[:, -1]
                inside = np.linspace(low, high, 9) >= 0.9
                assert (np.abs(every[0, inside]) <= 0.7 + 1e-8).all()
            innovations.append(state - predicted)
        assert (np.abs(state) <= 0.55 + 1e-8).all()


@pytest.mark.slow
@pytest.mark.parametrize("cost", ["peak", "nominal"])
def test_a_plant_that_is_dressed_in_time_costs_what_it_does_without(cost: str, tmp_path: Path) -> None:
    plain = {
        **TURNING,
        "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]], "E": [[0.5, 0], [0, 1]]},
        "path": [{"box": [0.95, None], "from": 0.5}],
    }
    dressed = {**plain, "system": {**plain["system"], "A": [[0, 1], ["-2 + 0*t", -0.5]]}}
    found = [run(one, tmp_path / str(k), cost, **pieces(3)) for k, one in enumerate((plain, dressed))]
    assert {one.status for one in found} == {"certified"}
    assert found[1].result.cost == pytest.approx(found[0].result.cost, rel=1e-8)
    assert check(found[1].directory).status == "verified"


@pytest.mark.slow
def test_other_units_change_nothing(tmp_path: Path) -> None:
    """Seconds as milliseconds, what is fading in thousandths."""
    other = {
        **FADING,
        "system": {"A": [["-0.001/(1 + 0.001*t)"]], "B": [[1.0]], "E": [["0.001*cos(0.003*t)"]]},
        "horizon": 3000.0,
        "initial_state": [2000.0],
        "control": {"box": 1.5},
        "disturbance": {"box": 300.0},
        "path": [{"box": [1000.0], "from": 1500.0}],
        "terminal": [{"box": [300.0]}],
    }
    found = [run(one, tmp_path / str(k), "peak", **pieces(3)) for k, one in enumerate((FADING, other))]
    proven(found[1])
    assert found[1].result.cost == pytest.approx(1e3 * found[0].result.cost, rel=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_certificate_is_found(name: str, tmp_path: Path, turning: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(turning, copy)
    file = copy / "certificate.json"
    data = json.loads(file.read_text())
    if name == "a gain that answers more":
        data["gains"][2][1][0][1] += 0.5
    else:
        FORGERIES[name](data)
    file.write_text(json.dumps(data))
    assert check(copy).status == "refuted"


@pytest.mark.slow
def test_more_than_any_policy_withstands_is_infeasible_with_its_reason(tmp_path: Path) -> None:
    outcome = run({**FADING, "disturbance": {"box": 1.6}}, tmp_path / "run", **pieces(3))
    assert outcome.status == "infeasible"
    assert check(outcome.directory).status == "verified"


ATV: Problem = {
    "name": "rendezvous",
    "orbit": {"semi_major_axis": 6763e3, "eccentricity": 0.0052, "mu": 3.986e14},
    "motion": "planar",
    "horizon": 7200,
    "initial_state": {"centre": [-30e3, 500, 8.514, 0], "box": [20, 20, 0.02, 0.02]},
    "control": {"box": 0.05},
    "disturbance": {"box": 1e-5},
    "disturbance_class": "measurable",
    "path": [{"name": "corridor", "polytope": {"H": [[0.15, 1, 0, 0], [0.15, -1, 0, 0]], "h": [50, 50]}, "from": 6600}],
    "terminal": [{"box": {"lower": [-700, -60, -0.1, -0.1], "upper": [-100, 60, 0.1, 0.1]}}],
}


@pytest.mark.slow
def test_a_law_that_takes_over_within_a_piece_changes_nothing_if_it_is_the_same(tmp_path: Path) -> None:
    law = FADING["system"]
    turns = {**FADING, "system": {"pieces": [{"until": 1.3, **law}, {"until": 3.0, **law}]}}
    found = [run(one, tmp_path / str(k), "peak", **pieces(3)) for k, one in enumerate((FADING, turns))]
    assert found[1].result.cost == pytest.approx(found[0].result.cost, rel=1e-8)
    assert check(found[1].directory).status == "verified"


@pytest.mark.slow
def test_a_rendezvous_about_an_ellipse_is_proven_against_accelerations_that_may_change_at_any_time(
    tmp_path: Path,
) -> None:
    outcome = run(ATV, tmp_path / "run", **pieces(6))
    proven(outcome)
    held = {**ATV, "disturbance_class": "piecewise_constant"}
    lower = run(held, tmp_path / "held", **pieces(6), causal_signals=0)
    assert lower.status == "certified"
    assert lower.result.lower_bound <= outcome.result.cost
