"""Guards known answers: measurable disturbances of switched systems, with delays, with a control that is a sum of
functions, in a window, and beside others that are constant on pieces. They are compared with a program on a fine grid,
values by hand, and forgeries."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.control.studies.adversary import find_adversary
from sparserob_core.control.transcription.transcribe import prepare
from tests.support import tampering

FIRST: dict[str, Any] = {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]}
SECOND: dict[str, Any] = {"A": [[0, 1], [-3, -0.2]], "B": [[0], [1.5]], "E": [[1, 0.5], [0, 1]]}
TURNS = {"pieces": [{"until": 2.0, **FIRST}, {"until": 5.0, **SECOND}]}
SPRING: dict[str, Any] = {
    "name": "linear", "horizon": 5.0, "initial_state": [-1, 1], "control": {"box": 1.0}, "disturbance": {"box": 0.03},
    "disturbance_class": "measurable", "path": [{"box": [0.7, None], "from": 0.5}], "terminal": [{"box": 0.5}],
}  # fmt: skip
LATE = {**TURNS, "delay": 0.15}
HAAR = {"name": "haar", "pieces": 16}


def ran(place: Path, dictionary: Any, **more: Any) -> sr.Outcome:
    control = {"name": "piecewise_constant", "pieces": dictionary} if isinstance(dictionary, int) else dictionary
    config = {"problem": {**SPRING, **more}, "dictionaries": {"control": control}, "observers": []}
    return sr.run(config, out=place, quiet=True, figures=False)


def on_a_fine_grid(
    w: float,
    delay: float = 0.0,
    window: tuple[float, float] = (0.0, 5.0),
    held: np.ndarray | None = None,
    count: int = 10,
    steps: int = 200,
) -> float:
    """The least cost where the constraints hold at the times of a fine grid and disturbances are constant between
    them, components in ``held`` on the pieces of the control: a lower bound, which misses little."""
    total = count * steps
    h, free, R = 5.0 / total, np.array([-1.0, 1.0]), np.zeros((2, count))
    W, rows, limits = np.zeros((2, total, 2)), [], []
    made = [
        expm(h * np.vstack([np.hstack([one["A"], one["B"], one.get("E", np.eye(2))]), np.zeros((3, 5))]))
        for one in (FIRST, SECOND)
    ]
    for j in range(total):
        middle = (j + 0.5) * h
        step, acting = made[middle > 2.0], int(np.floor((middle - delay) / (5.0 / count)))
        free, R, W = step[:2, :2] @ free, step[:2, :2] @ R, np.einsum("ij,jkl->ikl", step[:2, :2], W)
        if acting >= 0:
            R[:, acting] += step[:2, 2]
        if window[0] < middle < window[1]:
            W[:, j] += step[:2, 3:]
        sides = np.array([0.7 if (j + 1) * h >= 0.5 - 1e-9 else np.inf, np.inf])
        sides = np.minimum(sides, 0.5) if j == total - 1 else sides
        for i in np.flatnonzero(np.isfinite(sides)):
            pushed = W[i]
            if held is not None:
                on_pieces = pushed.reshape(count, steps, 2).sum(axis=1)
                pushed = np.concatenate([pushed[:, ~held].ravel(), on_pieces[:, held].ravel()])
            room = sides[i] - w * np.abs(pushed).sum()
            rows += [R[i], -R[i]]
            limits += [room - free[i], room + free[i]]
    G = np.array(rows)
    found = linprog(
        np.full(2 * count, 5.0 / count), A_ub=np.hstack([G, -G]), b_ub=limits, bounds=[(0, 1)] * (2 * count)
    )
    assert found.status == 0
    return float(found.fun)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 0.15])
def test_turns_cost_what_a_fine_grid_says_and_every_claim_holds(delay: float, tmp_path: Path) -> None:
    found = ran(tmp_path / "run", 10, system={**TURNS, "delay": delay})
    assert found.status == "certified"
    below = on_a_fine_grid(0.03, delay)
    assert below * (1 - 1e-9) <= found.result.cost <= below * (1 + 2e-4)
    assert sr.check(tmp_path / "run").status == "verified"


@pytest.mark.slow
def test_a_window_costs_what_a_fine_grid_says_and_every_claim_holds(tmp_path: Path) -> None:
    within = [{"set": {"box": [0.06, 0.06]}, "from": 1.0, "to": 3.3, "class": "measurable"}]
    more: dict[str, Any] = {"system": TURNS, "disturbance": within, "disturbance_class": "piecewise_constant"}
    found = ran(tmp_path / "run", 10, **more)
    assert found.status == "certified"
    below = on_a_fine_grid(0.06, window=(1.0, 3.3))
    assert below * (1 - 1e-9) <= found.result.cost <= below * (1 + 2e-4)
    assert sr.check(tmp_path / "run").status == "verified"


@pytest.mark.slow
@pytest.mark.parametrize("dictionary", [8, HAAR], ids=["pieces", "haar"])
def test_one_system_told_in_pieces_is_that_system(dictionary: Any, tmp_path: Path) -> None:
    one = ran(tmp_path / "one", dictionary, system=FIRST)
    two = ran(tmp_path / "two", dictionary, system={"pieces": [{"until": t, **FIRST} for t in (1.3, 3.1, 5.0)]})
    assert one.status == two.status == "certified"
    assert two.result.cost == pytest.approx(one.result.cost, rel=1e-7)
    assert {sr.check(tmp_path / name).status for name in ("one", "two")} == {"verified"}


def integrator(**more: Any) -> sr.OptimalControlProblem:
    """``x' = u + w`` from 1 to at most 0.4 within 2: what the disturbance pushes is paid for."""
    return sr.OptimalControlProblem(
        **{
            "system": sr.LinearSystem([[0.0]], [[1.0]]),
            "horizon": 2.0,
            "initial_state": [1.0],
            "control": sr.Box([-1.0], [1.0]),
            "terminal": [sr.Box([-9.0], [0.4])],
            **more,
        }
    )


FOUR = {"name": "piecewise_constant", "pieces": 4}


@pytest.mark.first(2)
@pytest.mark.parametrize(("start", "stop"), [(0.5, 1.5), (0.25, 1.6), (1.9, None), (0.0, 0.3)])
def test_in_a_window_a_measurable_disturbance_pushes_as_long_as_it_acts(
    start: float, stop: float | None, tmp_path: Path
) -> None:
    within = sr.Disturbance(sr.Box([-0.1], [0.1]), [[2.0]], "measurable", start=start, stop=stop)
    result = sr.solve(integrator(disturbances=[within]), control=FOUR)
    assert result.status == "certified"
    assert result.cost == pytest.approx(0.6 + 0.2 * ((2.0 if stop is None else stop) - start), rel=1e-6)
    assert sr.check(result.save(tmp_path / "run", figures=False)).status == "verified"


@pytest.mark.slow
def test_two_windows_of_a_measurable_disturbance_are_one(tmp_path: Path) -> None:
    """Of what is constant on pieces that is not so: on the piece across the cut both parts are one value."""
    whole = {"set": {"box": [0.03, 0.03]}, "class": "measurable"}
    more: dict[str, Any] = {"system": FIRST, "disturbance_class": "piecewise_constant"}
    one = ran(tmp_path / "one", 8, disturbance=[whole], **more)
    two = ran(tmp_path / "two", 8, disturbance=[{**whole, "to": 1.7}, {**whole, "from": 1.7}], **more)
    assert two.result.cost == pytest.approx(one.result.cost, rel=1e-7)
    assert sr.check(tmp_path / "two").status == "verified"


def test_an_integral_that_begins_later_is_proven_beside_measurable_disturbances(tmp_path: Path) -> None:
    """``x' = u + w`` from 1: the mean of ``x`` over the last half is at most 0.4 for every ``|w| <= 0.1``. The control
    lowers ``x`` by ``1 - x``; over ``[1, 2]`` a push at time ``s`` counts ``1`` before 1 and ``2 - s`` after."""
    bound = sr.IntegralConstraint(H=[[1.0]], upper=[0.4], start=1.0, stop=2.0)
    problem = integrator(
        disturbance=sr.Box([-0.1], [0.1]), disturbance_class="measurable", terminal=[], integral=[bound]
    )
    result = sr.solve(problem, control=FOUR)
    assert result.status == "certified"
    assert result.cost == pytest.approx(0.6 + 0.1 * 1.5, rel=1e-6)
    assert sr.check(result.save(tmp_path / "run", figures=False)).status == "verified"


def _random(seed: int) -> tuple[sr.OptimalControlProblem, sr.Dictionary]:
    rng = np.random.default_rng(seed)
    d, m, ends = 3, 2, [0.0, *np.sort(rng.uniform(0.2, 1.8, 2)), 2.0]
    made = [
        (until, sr.LinearSystem(rng.normal(size=(d, d)), rng.normal(size=(d, m)), rng.normal(size=(d, 2))))
        for until in ends[1:]
    ]
    problem = sr.OptimalControlProblem(
        system=sr.SwitchedSystem(made, delay=0.15),
        horizon=2.0,
        initial_state=rng.normal(size=d),
        initial_set=sr.Ellipsoid(np.zeros(d), 0.01 * np.eye(d)),
        initial_control=rng.normal(size=m),
        control=sr.Box(-np.ones(m), np.ones(m)),
        disturbance=sr.NormBall(1.0, 0.2, dimension=2),
        disturbance_class="measurable",
        path=[sr.PathConstraint(sr.Box(-np.ones(d), np.ones(d)), 0.0, 2.0)],
    )
    return problem, sr.Dictionary(np.linspace(0, 2, 8), np.eye(7))


def _pushed(problem: sr.OptimalControlProblem, time: float, direction: np.ndarray, steps: int = 4000) -> float:
    """How far disturbances push a direction by a time, by the middles of many steps of every turn."""
    row, total, begins = direction.copy(), 0.0, [0.0, *problem.system.switches]
    for begin, mode in reversed(list(zip(begins, problem.system.modes, strict=True))):
        if time <= begin:
            continue
        A, _, E = (part[0] for part in mode.matrices(np.zeros((1, 0))))
        h = (time - begin) / steps
        half, whole = expm(h / 2 * A), expm(h * A)
        for _ in range(steps):
            total += 0.2 * np.abs(row @ half @ E).max() * h  # a ball of the 1-norm
            row = row @ whole
        time = begin
    return float(total)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_what_measurable_disturbances_do_over_turns_is_enclosed(seed: int) -> None:
    problem, control = _random(seed)
    support = prepare(problem, control, control).functionals.measurable
    rng = np.random.default_rng(seed)
    times = np.array([0.3 * problem.system.switches[0], *problem.system.switches, 1.93, 2.0])
    directions = rng.normal(size=(times.size, 3))
    low, high = support.enclosed(times, directions).T
    assert (high - low <= 1e-11 * high).all()
    plain = support(times, directions, np.zeros((times.size, 0)))
    assert (np.abs(plain - high) <= 1e-11 * high).all()
    dense = [_pushed(problem, float(t), c) for t, c in zip(times, directions, strict=True)]
    assert high == pytest.approx(dense, rel=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_bounds_of_cells_over_turns_are_above_every_violation_and_close(seed: int) -> None:
    problem, control = _random(seed)
    constraint, rng = prepare(problem, control, control).constraints[0], np.random.default_rng(seed)
    x = rng.normal(size=14)
    breaks = constraint.functionals.response.grid.breakpoints
    for k in rng.integers(breaks.size - 1, size=12):
        for width in (0.02, 0.002):
            low = breaks[k] + rng.uniform(0, 0.5) * (breaks[k + 1] - breaks[k])
            high = min(low + width, breaks[k + 1])
            bound = constraint.enclosure(x, np.array([[low]]), np.array([[high]])).bounds[0]
            points = rng.uniform(low, high, size=(60, 1))
            points[:2, 0] = low, high
            seen = max(constraint.violations(x, points, np.full(60, row)).max() for row in range(6))
            assert seen <= bound <= seen + 500.0 * (high - low) ** 2 + 1e-9


def test_the_gradient_over_turns_is_the_slope_of_a_violation() -> None:
    problem, control = _random(5)
    model = prepare(problem, control, control)
    constraint, family = model.constraints[0], model.program.families[0]
    x, indices = np.random.default_rng(5).normal(size=14), np.array([[0.33], [1.07], [1.61], [1.93]])
    rows, step = np.array([0, 4, 2, 1]), 1e-5
    assert family.gradient is not None
    ends = [constraint.violations(x, indices + sign * step, rows) for sign in (1, -1)]
    assert family.gradient(x, indices, rows)[:, 0] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-4)


def test_the_worst_signal_over_turns_attains_the_violation() -> None:
    problem, control = _random(3)
    model = prepare(problem, control, control)
    x = np.random.default_rng(3).normal(size=14)
    worst = find_adversary(model.constraints[0], x)
    assert worst is not None and worst.disturbance is not None
    u, state, begins = x.reshape(2, 7), worst.initial_state.copy(), np.array([0.0, *problem.system.switches])
    ends = np.unique(np.concatenate([worst.breakpoints, begins, np.linspace(0, 2, 8)[:-1] + 0.15]))
    for start, stop in zip(ends[:-1], np.minimum(ends[1:], worst.time), strict=True):
        if stop <= start:
            break
        middle = (start + stop) / 2
        mode = problem.system.modes[np.searchsorted(begins, middle) - 1]
        A, B, E = (part[0] for part in mode.matrices(np.zeros((1, 0))))
        acting = np.asarray(problem.initial_control) if middle < 0.15 else u[:, int((middle - 0.15) / (2 / 7))]
        w = worst.disturbance[:, np.searchsorted(worst.breakpoints, middle) - 1]
        block = np.vstack([np.column_stack([A, B @ acting + E @ w]), np.zeros(4)])
        state = (expm((stop - start) * block) @ np.append(state, 1.0))[:3]
    assert worst.direction @ state - worst.bound == pytest.approx(worst.violation, rel=1e-8)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("turns") / "run"
    assert ran(directory, {"name": "haar", "pieces": 8}, system=LATE).status == "certified"
    assert sr.check(directory).status == "verified"
    return directory


def _until(time: float) -> tampering.Change:
    return lambda files: files.system["pieces"][0].update(until=time)


def _second(**changes: Any) -> tampering.Change:
    return lambda files: files.system["pieces"][1].update(changes)


def _decision(step: float) -> tampering.Change:
    def change(files: tampering.Forgery) -> None:
        files.decision[0][0] += step

    return change


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        _until(2.02),
        _until(1.98),
        _second(E=[[1, 0.52], [0, 1]]),
        _second(A=[[0, 1], [-3, -0.19]]),
        lambda files: files.system.update(delay=0.155),
        lambda files: files.problem.update(disturbance={"box": 0.0301}),
        lambda files: files.certificate.update(lower_bound=files.certificate["lower_bound"] + 1e-6),
        _decision(1e-5),
        _decision(-1e-5),
    ],
    ids=["later", "earlier", "E", "A", "delay", "larger", "bound", "more", "less"],
)
def test_what_is_changed_afterwards_is_refuted(change: tampering.Change, finished: Path, tmp_path: Path) -> None:
    forged = tampering.forged(finished, tmp_path / "copy", change, consistent=True)
    assert sr.check(forged).status == "refuted"


@pytest.mark.slow
def test_worst_cases_over_turns_are_bounded_from_both_sides_and_checked(finished: Path, tmp_path: Path) -> None:
    found = sr.bound(finished, out=tmp_path / "bound")
    assert {abs(row.proven - row.reached) < 1e-8 for row in found.rows} == {True}
    assert sr.check(tmp_path / "bound").status == "verified"


def test_initial_states_beside_measurable_disturbances_over_turns(tmp_path: Path) -> None:
    """``x' = x (1 or 2) + u + w`` from ``-1 +- 0.05``: what is pushed until the end is answered by a control that sees
    neither, so that the least cost is that of the worst corner."""
    system = {"pieces": [{"until": 0.5, "A": [[1]], "B": [[1]]}, {"until": 1.0, "A": [[2]], "B": [[1]]}]}
    more: dict[str, Any] = {
        "system": system, "horizon": 1.0, "initial_state": {"centre": [-1], "box": [0.05]}, "control": {"box": 9.0},
        "disturbance": {"box": [0.1]}, "path": [], "terminal": [{"box": [2.0]}],
    }  # fmt: skip
    found = ran(tmp_path / "run", 1, **more)
    grown, pushed = np.exp(1.5), np.exp(1.0) * (np.exp(0.5) - 1.0) + (np.exp(1.0) - 1.0) / 2.0
    assert found.status == "certified"
    assert found.result.cost == pytest.approx((1.05 * grown + 0.1 * pushed - 2.0) / pushed, rel=1e-7)
    assert sr.check(tmp_path / "run").status == "verified"


def of_two_classes(first: float = 0.03, second: float = 0.03, **other: Any) -> dict[str, Any]:
    """The first component any function of time, the second constant on pieces; both enter as they are."""
    one = {"set": {"box": [first]}, "E": [[1], [0]], "class": "measurable", **other}
    two = {"set": {"box": [second]}, "E": [[0], [1]], "class": "piecewise_constant"}
    return {"disturbance": [one, two], "disturbance_class": "measurable"}


PLAIN = {"pieces": [TURNS["pieces"][0], {**TURNS["pieces"][1], "E": [[1, 0], [0, 1]]}]}


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("two") / "run"
    assert ran(directory, 10, system={**FIRST, "delay": 0.15}, **of_two_classes()).status == "certified"
    assert sr.check(directory).status == "verified"
    return directory


@pytest.mark.slow
def test_two_classes_cost_less_than_one_that_does_all(two: Path, tmp_path: Path) -> None:
    cost = json.loads((two / "result.json").read_text())["cost"]
    all_of_it = ran(tmp_path / "more", 10, system={**FIRST, "delay": 0.15})
    held = ran(tmp_path / "less", 10, system={**FIRST, "delay": 0.15}, disturbance_class="piecewise_constant")
    assert held.result.cost * (1 + 1e-6) < cost < all_of_it.result.cost * (1 - 1e-6)


@pytest.mark.slow
def test_two_classes_over_turns_cost_what_a_fine_grid_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SECOND, "E", np.eye(2).tolist())
    found = ran(tmp_path / "run", 10, system=PLAIN, **of_two_classes())
    below = on_a_fine_grid(0.03, held=np.array([False, True]))
    assert below * (1 - 1e-9) <= found.result.cost <= below * (1 + 2e-4)
    assert sr.check(tmp_path / "run").status == "verified"


@pytest.mark.slow
def test_two_classes_are_bounded_simulated_and_have_a_margin(two: Path, tmp_path: Path) -> None:
    found = sr.bound(two, out=tmp_path / "bound")
    assert {abs(row.proven - row.reached) < 1e-8 for row in found.rows} == {True}
    assert sr.check(tmp_path / "bound").status == "verified"
    replayed = sr.simulate(two, law="adversary").constraints
    assert [one.largest for one in replayed] == pytest.approx([one.worst for one in replayed], abs=1e-9)
    drawn = sr.simulate(two, 50).constraints
    assert all(one.largest <= one.worst + 1e-9 for one in drawn)


def _class(number: int, kind: str) -> tampering.Change:
    return lambda files: files.problem["disturbance"][number].update({"class": kind})


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        _class(1, "measurable"),
        lambda files: files.problem["disturbance"][0].update(set={"box": [0.0301]}),
        lambda files: files.problem["disturbance"][1].update(set={"box": [0.0301]}),
        lambda files: files.problem["disturbance"][1].update(E=[[0.02], [1]]),
        lambda files: files.certificate.update(lower_bound=files.certificate["lower_bound"] + 1e-6),
        _decision(1e-5),
    ],
    ids=["class", "measurable", "held", "E", "bound", "decision"],
)
def test_what_is_changed_of_two_classes_is_refuted(change: tampering.Change, two: Path, tmp_path: Path) -> None:
    assert sr.check(tampering.forged(two, tmp_path / "copy", change, consistent=True)).status == "refuted"


@pytest.mark.slow
def test_a_bound_whose_held_disturbance_jumps_within_a_piece_is_refuted(two: Path, tmp_path: Path) -> None:
    sr.bound(two, out=tmp_path / "bound")
    place = next((tmp_path / "bound").glob("bound.json"))
    data = json.loads(place.read_text())
    row = next(row for row in data["rows"] if len(row["changes"]) > 12)
    inside = next(k for k, t in enumerate(row["changes"]) if 0 < k < len(row["changes"]) - 2 and (t / 0.5) % 1 > 1e-6)
    row["disturbance"][1][inside] = -row["disturbance"][1][inside]
    place.write_text(json.dumps(data))
    assert sr.check(tmp_path / "bound").status == "refuted"


def test_two_classes_are_refused_where_they_are_not_proven(tmp_path: Path) -> None:
    for more, key in (
        ({"policy": "affine"}, "policy"),
        ({"dictionaries": {"control": FOUR, "disturbance": {"name": "walsh", "pieces": 8, "functions": 3}}}, "dict"),
    ):
        config = {"problem": {**SPRING, "system": FIRST, **of_two_classes()}, "observers": []}
        config = {**config, "dictionaries": {"control": FOUR}, **more}
        with pytest.raises(sr.InputError, match=key):
            sr.run(config, out=tmp_path / "run", quiet=True, figures=False)
    with pytest.raises(sr.InputError, match="disturbance_class"):
        integrator(disturbance=sr.Box([-0.1], [0.1]), disturbance_class=("piecewise_constant", "measurable"))
