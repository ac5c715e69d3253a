"""Guards own units (docs/decisions/0016): an answer does not depend on units, nor on the factors of rows.

The files in ``units/`` once had wrong answers; their truths were computed independently (HiGHS programs with exact
worst cases, dense simulation, arithmetic of 600 bits).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.response.inner_loop import Weights
from sparserob_core.control.response.response import Propagator
from sparserob_core.sip.methods.own_units import UsersUnits
from tests.support.draws import taken

FILES = Path(__file__).parent / "units"
HEAVY = {"32_weights_1e-7", "f124", "hcw_seconds"}
INFEASIBLE = ("01", "11", "15", "16", "18", "21", "22", "23", "25", "27")
COSTS = {
    "14_units_1e5_terminal_only": 1.569187687,
    "19_dist_row_1e-09": 0.9,
    "19_dist_row_1e-12": 0.9,
    "19_dist_row_1e-15": 0.9,
    "20_param_row_1e-09": 0.708240960,
    "20_param_row_1e-12": 0.708240960,
    "33_dist_polytope_row_1e-6_check_refutes": 1.1,
    "33_zero_box_equals": 2.0,
    "34_param_polytope_row_1e-5_check_refutes": 0.708240960,
    # multipliers of a million: rounding must not keep the gap open; rows that are kept to 1e-9 of their unit move this
    # cost by 4e-8 of itself from one machine to the next. This is the vertex in 50 digits, with exact transitions
    "f124": 1.370509844,
    "f20023": 0.0,
    "f364": 1.527350367,
    "pulse1e+06_8e-14": 1.5,
}


def run(name: str, out: Path) -> sr.Result:
    return sr.run(FILES / f"{name}.yaml", {"observers": []}, out=out, quiet=True, figures=False).result


@pytest.mark.first(6)
@pytest.mark.parametrize("name", sorted(path.stem for path in FILES.glob("*.yaml") if path.stem[:2] in INFEASIBLE))
def test_what_is_outside_in_its_own_unit_is_infeasible(name, tmp_path):
    result = run(name, tmp_path / "run")
    assert result.status == "infeasible", result.message


def feasible() -> list[object]:
    """The files of feasible problems, a heavy one only where the second stage is run."""
    names = sorted(path.stem for path in FILES.glob("*.yaml") if path.stem[:2] not in INFEASIBLE)
    return [pytest.param(name, marks=pytest.mark.slow if name in HEAVY else ()) for name in names]


@pytest.mark.first(4)
@pytest.mark.parametrize("name", feasible())
def test_what_is_feasible_in_its_own_unit_is_certified(name, tmp_path):
    result = run(name, tmp_path / "run")
    if name.startswith("32"):  # the weights of two controls differ by 1e7 and more
        assert result.status in ("certified", "verified") and result.gap <= 1e-4, result.message
        assert result.cost == pytest.approx(1.606 * 10.0 ** -int(name[-1]), rel=1e-3)
        return
    assert result.status == "certified", result.message
    if name.startswith("02"):  # controls of 1e12 are admissible: the gap is closed by definition, the interval narrow
        assert result.cost - result.lower_bound <= 0.025 * result.cost
    if name in COSTS:
        assert result.cost == pytest.approx(COSTS[name], rel=5e-8 if name == "f124" else 2e-8, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_rows_that_are_off_by_a_rounding_are_not_violated_for_want_of_a_sharper_program(seed, tmp_path, monkeypatch):
    """The regularised program of rows that are nearly parallel is answered crudely, for some roundings of the rows;
    then the plain one decides, by a vertex where the interior-point method has no answer either."""
    weights, rng = Propagator.weights, np.random.default_rng(seed)
    off: dict[bytes, np.ndarray] = {}

    def rounded(part: np.ndarray) -> np.ndarray:
        return part * off.setdefault(part.tobytes(), 1.0 + 1e-15 * rng.uniform(-1.0, 1.0, part.shape))

    monkeypatch.setattr(Propagator, "weights", lambda *given: Weights(*(rounded(part) for part in weights(*given))))
    result = run("f124", tmp_path / "run")
    assert result.status in ("certified", "verified") and result.gap <= 2e-7, result.message


@dataclass(frozen=True)
class Factors:
    """How many of the problem's own units one of the user's is; and the factors of the rows."""

    time: float = 1.0
    states: np.ndarray = field(default_factory=lambda: np.ones(2))
    control: float = 1.0
    noise: np.ndarray = field(default_factory=lambda: np.ones(2))
    parameter: float = 1.0
    weight: float = 1.0
    rows: np.ndarray = field(default_factory=lambda: np.ones(5))

    @staticmethod
    def drawn(rng: np.random.Generator, binary: bool) -> Factors:
        def some(size: int | None = None) -> np.ndarray:
            return 2.0 ** rng.integers(-40, 41, size) if binary else 10.0 ** rng.uniform(-12, 12, size)

        return Factors(some(), some(2), some(), some(2), some(), some(), some(5))

    @property
    def cost(self) -> float:
        """What a cost of 1 of the problem is in the user's units."""
        return self.weight / self.control / self.time


def oscillator(kind: str, f: Factors) -> sr.OptimalControlProblem:
    """The same oscillator in any units: ``x_user = x / states``, ``t_user = t / time`` and so on."""
    to, x = f.time / f.states[:, None], f.states
    B, E = to * np.array([[0.0], [1.0]]) * f.control, to * np.eye(2) * f.noise
    H = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 1.0]])
    h = np.array([1.2, 1.2, 1.2, 1.2, 1.5])

    def A(p):
        k = p[0] * f.parameter if kind == "uncertain" else 0.0
        return np.array([[0.0 * k, to[0, 0] * x[1] * (1.0 + 0.0 * k)], [to[1, 0] * x[0] * (-1.0 - k), -0.5 * f.time]])

    parameters = sr.Box([-0.1 / f.parameter], [0.1 / f.parameter]) if kind == "uncertain" else None
    shape = np.array([[1.5, 0.2], [0.2, 1.1]]) / np.outer(x, x)
    path = sr.Ellipsoid(np.zeros(2), shape) if kind == "curved" else sr.Polytope(f.rows[:, None] * H * x, f.rows * h)
    corners = np.array([[1.0, 1.0], [-1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
    noise = sr.Polytope(f.rows[:4, None] * corners * f.noise, f.rows[:4] * 0.03)
    end = (
        [sr.Equality(np.array([0.0, np.nan]))]
        if kind == "fixed"
        else [sr.Box(-np.array([0.25, 0.22]) / x, np.array([0.25, 0.22]) / x)]
    )
    return sr.OptimalControlProblem(
        system=sr.LinearSystem(A if parameters is not None else A([0.0]), B, E, parameters=parameters),
        horizon=3.0 / f.time,
        initial_state=np.array([1.0, 0.3]) / x,
        initial_set=sr.Ellipsoid(np.zeros(2), np.diag((np.array([0.03, 0.05]) / x) ** 2)) if kind == "begun" else None,
        control=sr.Box([-1.0 / f.control], [1.0 / f.control]),
        weights=[f.weight],
        disturbance=None if kind == "fixed" else noise,
        path=[path],
        terminal=end,
    )


def solved(problem: sr.OptimalControlProblem) -> sr.Result:
    return sr.solve(problem, control={"name": "piecewise_constant", "pieces": 15})


def active(result: sr.Result) -> set[tuple[str, int]]:
    return {(cut.family, cut.row) for cut in result.indices}


KINDS = ("known", "uncertain", "curved", "fixed", "begun")


@pytest.fixture(scope="module", params=KINDS)
def plain(request) -> tuple[str, sr.Result]:
    return request.param, solved(oscillator(request.param, Factors()))


@pytest.mark.first(2)
@pytest.mark.parametrize("seed", range(2))
def test_units_that_are_powers_of_two_change_no_bit(plain, seed):
    kind, one = plain
    f = Factors.drawn(np.random.default_rng(seed), binary=True)
    other = solved(oscillator(kind, f))
    assert one.status == other.status == "certified", other.message
    assert other.cost / f.cost == one.cost and other.lower_bound / f.cost == one.lower_bound
    np.testing.assert_array_equal(other.decision * f.control, one.decision)
    for mine, theirs in zip(one.indices, other.indices, strict=True):
        assert mine.row == theirs.row
        assert theirs.index[0] * f.time == mine.index[0]


@pytest.mark.first(1)
@pytest.mark.parametrize("seed", range(2))
def test_any_units_leave_the_status_the_cost_and_the_active_constraints(plain, seed):
    kind, one = plain
    f = Factors.drawn(np.random.default_rng(100 + seed), binary=False)
    other = solved(oscillator(kind, f))
    assert one.status == other.status == "certified", other.message
    assert other.cost / f.cost == pytest.approx(one.cost, rel=1e-6)
    assert active(one) == active(other)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(taken(40)))
def test_a_sweep_of_units_leaves_the_status_and_the_cost(plain, seed):
    kind, one = plain
    f = Factors.drawn(np.random.default_rng(1000 + seed), binary=False)
    other = solved(oscillator(kind, f))
    assert one.status == other.status
    assert other.cost / f.cost == pytest.approx(one.cost, rel=1e-6)


def test_results_are_in_the_users_units():
    """A witness, a violation and events of a problem in odd units are those of the plain one, converted."""
    f = Factors(time=8.0, states=np.array([2.0**-20, 2.0**7]), control=4.0, weight=2.0**-9)
    told: dict[str, list[sr.Event]] = {"plain": [], "odd": []}
    results = {}
    for name, factors in (("plain", Factors()), ("odd", f)):
        results[name] = sr.solve(
            oscillator("known", factors),
            "nominal",
            control={"name": "piecewise_constant", "pieces": 15},
            notify=told[name].append,
        )
    one, other = results["plain"], results["odd"]
    assert one.status == other.status == "refuted"
    state = int(np.flatnonzero(np.array([[1, 0], [0, 1], [1, 0], [0, 1]])[one.worst.row % 4])[0])
    assert one.worst.constraint == other.worst.constraint == "terminal"
    assert other.worst.violation * f.states[state] == pytest.approx(one.worst.violation, rel=1e-12)
    assert other.worst.time * f.time == one.worst.time
    assert f"terminal is violated by {other.worst.violation:.4g}" in other.message
    rounds = [[event for event in events if isinstance(event, sr.RoundFinished)] for events in told.values()]
    for mine, theirs in zip(*rounds, strict=True):
        assert theirs.cost / f.cost == mine.cost
        np.testing.assert_array_equal(theirs.decision * f.control, mine.decision)


def written(f: Factors, curved: bool = False, uncertain: bool = False) -> dict[str, object]:
    """A config of the same oscillator, with an uncertain spring where asked for, in any units."""
    to, x = f.time / f.states[:, None], f.states
    spring = f"{to[1, 0] * x[0]:.17g} * (-1 - {0.1 * f.parameter:.17g} * p)" if uncertain else -float(to[1, 0] * x[0])
    H = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 1.0]])
    h = f.rows * np.array([1.2, 1.2, 1.2, 1.2, 1.5])
    flat = {"polytope": {"H": (f.rows[:, None] * H * x).tolist(), "h": h.tolist()}}
    disc = {"ellipsoid": {"centre": [0.0, 0.0], "shape": np.diag((np.array([0.25, 0.22]) / x) ** 2).tolist()}}
    return {
        "problem": {
            "name": "linear",
            "system": {
                "A": [[0.0, float(to[0, 0] * x[1])], [spring, -0.5 * f.time]],
                "B": [[0.0], [float(to[1, 0] * f.control)]],
                "E": (to * np.eye(2) * f.noise).tolist(),
                "parameters": {"p": [-1.0 / f.parameter, 1.0 / f.parameter]} if uncertain else None,
            },
            "horizon": 3.0 / f.time,
            "initial_state": (np.array([1.0, 0.3]) / x).tolist(),
            "control": {"box": 1.0 / f.control},
            "weights": [f.weight],
            "disturbance": {"box": (0.02 / f.noise).tolist()},
            "path": [flat],
            "terminal": [disc if curved else {"box": (np.array([0.25, 0.22]) / x).tolist()}],
        },
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 10}},
        "observers": [],
    }


def same_set(plain: sr.InitialStates, other: sr.InitialStates, f: Factors, unique: bool = True) -> None:
    """Each one's proven points are in the other's proven half-planes, and it is as large; so are the controls that
    prove it, where they are ``unique``."""
    assert other.status == plain.status in ("certified", "verified"), other.message
    x = f.states[list(plain.states)]
    size = np.abs(plain.outer).max()
    assert (plain.directions @ (other.inner * x).T <= plain.bounds[:, None] + 1e-6 * size).all()
    room = 1e-6 * np.abs(other.directions) @ (size / x)
    assert (other.directions @ (plain.inner / x).T <= (other.bounds + room)[:, None]).all()
    np.testing.assert_allclose(np.ptp(other.outer, axis=0) * x, np.ptp(plain.outer, axis=0), rtol=1e-5)
    if unique:
        np.testing.assert_allclose(np.abs(other.controls).max() * f.control, np.abs(plain.controls).max(), rtol=1e-6)
    middle = plain.inner.mean(axis=0)
    assert other.where(middle / x) == "inside" and other.where((9.0 * size + middle) / x) == "outside"
    if plain.costs.size:
        assert other.cost(middle / x) / f.cost == pytest.approx(plain.cost(middle), rel=1e-2)


@pytest.mark.slow
def test_a_set_of_initial_states_changes_by_its_units_only():
    plain, f = (
        sr.initial_states(written(Factors()), directions=6, values=0),
        Factors.drawn(np.random.default_rng(1), False),
    )
    same_set(plain, sr.initial_states(written(f), directions=6, values=0), f)


@pytest.mark.slow
@pytest.mark.parametrize("curved", [False, True], ids=["flat", "curved"])
def test_a_set_of_initial_states_with_costs_changes_by_its_units_only(curved):
    plain, f = (
        sr.initial_states(written(Factors(), curved), directions=8, values=1),
        Factors.drawn(np.random.default_rng(1), binary=True),
    )
    same_set(plain, sr.initial_states(written(f, curved), directions=8, values=1), f)


@pytest.mark.slow
def test_a_set_of_initial_states_of_an_uncertain_system_changes_by_its_units_only():
    plain = sr.initial_states(written(Factors(), uncertain=True), directions=4, values=0)
    f = Factors.drawn(np.random.default_rng(5), binary=False)
    same_set(plain, sr.initial_states(written(f, uncertain=True), directions=4, values=0), f, unique=False)


def same_margin(of: str, curved: bool, seed: int, binary: bool) -> None:
    uncertain = of == "parameters"
    plain = sr.margin(written(Factors(), curved, uncertain), of=of, tolerance=1e-4)
    assert plain.status in ("certified", "unbounded"), plain.message
    f = Factors.drawn(np.random.default_rng(seed), binary)
    other = sr.margin(written(f, curved, uncertain), of=of, tolerance=1e-4)
    assert other.status == plain.status, other.message
    unit = f.time if of.endswith("from") else 1.0
    assert other.lower * unit == pytest.approx(plain.lower, rel=2e-4, abs=1e-9)
    assert other.feasible.upper_bound / f.cost == pytest.approx(plain.feasible.upper_bound, rel=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("of", ["disturbance", "control", "terminal.0"])
def test_a_margin_changes_by_its_units_only(of):
    same_margin(of, curved=False, seed=10, binary=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("of", "curved"),
    [
        *((of, False) for of in ("path.0", "path.0.from", "parameters")),
        *((of, True) for of in ("disturbance", "terminal.0")),
    ],
)
def test_margins_of_everything_change_by_their_units_only(of, curved):
    same_margin(of, curved, seed=11, binary=True)


def test_bounds_of_proofs_are_in_the_users_units_and_shares_in_each_rows_own():
    f = Factors(time=4.0, states=np.array([2.0**-20, 2.0**7]), control=2.0, noise=np.array([2.0**-5, 8.0]))
    one, other = solved(oscillator("known", Factors())), solved(oscillator("known", f))
    for mine, theirs in zip(one.proofs, other.proofs, strict=True):
        assert theirs.share == mine.share is not None and mine.share <= 1e-9
        for proof in (mine, theirs):
            assert proof.bound == proof.share * (proof.units.max() if proof.share > 0.0 else proof.units.min())
    program = sr.transcribe(oscillator("known", f), control=sr.Dictionary(np.linspace(0.0, 0.75, 4), np.eye(3)))
    told = UsersUnits(program.own_units).event(sr.ProofProgress(family="path", cells=1, bound=2.0))
    assert told.bound == 2.0 * program.own_units.program.family("path").row_units.max()


@pytest.mark.parametrize("size", [1.0, 1e-9])
def test_a_tangent_of_a_curved_set_is_told_in_numbers_of_the_states(size):
    """Why x1 cannot come into a ball of half its size, in metres and in nanometres: no number is the inverse of a
    size."""
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0, size], [0, 0]], [[0.0], [1.0]]),
        horizon=1.0,
        initial_state=[size, 0.0],
        control=sr.Box([-0.1], [0.1]),
        path=[sr.Ellipsoid([0.0, 0.0], np.diag([0.25 * size**2, 0.25]))],
    )
    result = solved(problem)
    assert result.status == "infeasible" and "x1(0)" in result.message
    assert "e+0" not in result.message
