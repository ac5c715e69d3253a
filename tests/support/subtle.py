"""Forgeries that are off by little, in one component, row or unit each: every one of them makes a claim false."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from tests.support.tampering import Change, Forgery, problem, witness

ROWS: dict[str, Any] = {
    "name": "linear",
    "system": {"A": [[0, 0], [0, 0]], "B": [[1, 0], [0, 1e-3]]},
    "horizon": 2.0,
    "initial_state": [2.0, 3.0],
    "control": {
        "polytope": {
            "H": [[1e-3, 0], [-1, 0], [0, 1], [0, -1e-3], [-1e-2, -5e-6], [1e-2, 5e-6]],
            "h": [1e-3, 1, 2e3, 2, 1.4e-2, 1.4e-2],
        }
    },
    "weights": [1.0, 1e-3],
    "terminal": [{"box": [0.5, 1.0]}],
}
RUNS: dict[str, tuple[int, dict[str, Any]]] = {"rows": (5, ROWS)}
"""Pieces and problem of the runs that only these need: two integrators, states and controls in units far apart, rows of
the controls' polytope multiplied by small numbers."""

GAIN, LENGTH = (1.0, 1e-3), 0.4  # of each control on its state, of a piece
Forgeries = dict[str, tuple[str, Change]]


def theta(change: Callable[[np.ndarray], object], status: str | None = None) -> Change:
    """The decision of ``rows`` in place; the cost follows, so that it is no lie."""

    def apply(files: Forgery) -> None:
        decision = np.array(files.decision)
        change(decision)
        files.certificate["decision"] = decision.tolist()
        files.certificate["cost"] = float((np.abs(decision) * LENGTH * np.array([[1.0], [1e-3]])).sum())
        files.certificate["status"] = status or files.certificate["status"]

    return apply


def shifted(channel: int, piece: int, by: float) -> Change:
    return theta(lambda decision: decision.__setitem__((channel, piece), decision[channel, piece] + by))


def placed(piece: int, control: tuple[float, float]) -> Change:
    """One piece of the control elsewhere; nothing but that it is in its set is claimed of it."""
    return theta(lambda decision: decision.__setitem__((slice(None), piece), control), "verified")


OVER = 3e-9  # of a row's own unit
OUTSIDE = {
    "the lower bound of u1": (-1.0 - OVER, -100.0),
    "the lower bound of u2": (-0.1, -2000.0 * (1.0 + OVER)),
    "the slanted row": (-0.6, -1600.0 * (1.0 + 2 * OVER)),
}
COMPONENTS: Forgeries = {
    **{
        f"state {i + 1} ends a millionth of its wall outside, by piece {k}": (
            "rows",
            shifted(i, k, 2e-6 * (0.5, 1.0)[i] / (GAIN[i] * LENGTH)),
        )
        for i in range(2)
        for k in range(5)
    },
    **{
        f"piece {k} is 3e-9 beyond {name}": ("rows", placed(k, control))
        for name, control in OUTSIDE.items()
        for k in range(5)
    },
}

SOLVED = ("known", "one parameter", "minimum attention", "walsh", "haar", "equality", "integrator", "tiny", "rows")
FIGURES: Forgeries = {
    **{
        f"the cost of {name} is 1e-9 lower": (
            name,
            lambda files: files.certificate.update(cost=files.certificate["cost"] * (1 - 1e-9)),
        )
        for name in SOLVED
    },
    **{
        f"the lower bound of {name} is {raised:g} of it higher than proven": (
            name,
            lambda files, raised=raised: files.certificate.update(
                lower_bound=files.certificate["lower_bound"] * (1 + raised)
            ),
        )
        for name in SOLVED
        for raised in (1e-6,)
    },
}

WINDOWS = [
    ("known", "path"),
    ("known", "terminal"),
    ("one parameter", "terminal"),
    ("two parameters", "terminal"),
    ("ellipsoidal", "terminal"),
    ("integrator", "terminal"),
    ("rows", "terminal"),
]


def first_later(proof: dict[str, Any]) -> None:
    proof["lower"][0][0] = math.nextafter(proof["lower"][0][0], math.inf)


def last_earlier(proof: dict[str, Any]) -> None:
    proof["upper"][-1][0] = math.nextafter(proof["upper"][-1][0], 0.0)


def last_later(proof: dict[str, Any]) -> None:
    proof["upper"][-1][0] = math.nextafter(proof["upper"][-1][0], math.inf)


def last_gone(proof: dict[str, Any]) -> None:
    del proof["lower"][-1], proof["upper"][-1]


def one_twice(proof: dict[str, Any]) -> None:
    proof["lower"].append(proof["lower"][0])
    proof["upper"].append(proof["upper"][0])


def laxer(proof: dict[str, Any]) -> None:
    proof["tolerance"] = 1.001e-9


CELLS: Forgeries = {
    f"{change.__name__.replace('_', ' ')}: {window} of {name}": (
        name,
        lambda files, window=window, change=change: change(files.proof(window)),
    )
    for name, window in WINDOWS
    for change in (first_later, last_earlier, last_later, last_gone, one_twice, laxer)
}


def turned(component: int, piece: int) -> Change:
    def apply(files: Forgery) -> None:
        signal = files.certificate["witness"]["disturbance"]
        signal[component][piece] = -signal[component][piece]

    return apply


def nudged(component: int, piece: int) -> Change:
    """Out of its box by one unit in the last place."""

    def apply(files: Forgery) -> None:
        signal = files.certificate["witness"]["disturbance"]
        signal[component][piece] = math.copysign(math.nextafter(0.05, 1.0), signal[component][piece])

    return apply


def multiplied(key: str, factor: float) -> Change:
    return lambda files: witness(**{key: (factor * np.array(files.certificate["witness"][key])).tolist()})(files)


WITNESSES: Forgeries = {
    **{
        f"piece {k} of disturbance {i + 1} is turned round": ("refuted", turned(i, k))
        for i in range(2)
        for k in (25, 30, 35, 38, 39)
    },
    **{
        f"piece {k} of disturbance {i + 1} is outside by rounding": ("refuted", nudged(i, k))
        for i in range(2)
        for k in (0, 39)
    },
    "the violation is a hundred thousandth larger": ("refuted", multiplied("violation", 1 + 1e-5)),
    "the violation is a hundred thousandth smaller": ("refuted", multiplied("violation", 1 - 1e-5)),
    "the direction is a hundred thousandth longer": ("refuted", multiplied("direction", 1 + 1e-5)),
    "the time is past the horizon by rounding": ("refuted", witness(time=math.nextafter(5.0, 6.0))),
    "the parameter is outside by rounding": ("refuted parameter", witness(parameter=[math.nextafter(0.5, 0.0)])),
    "the parameter is another one by a thousandth": (
        "refuted parameter",
        lambda files: witness(parameter=[files.certificate["witness"]["parameter"][0] + 1e-3])(files),
    ),
}


def entry_of(*path: Any, by: float = 0.0, times: float = 1.0) -> Change:
    """One number of the problem, changed a little."""

    def apply(files: Forgery) -> None:
        place: Any = files.problem
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = place[path[-1]] * times + by

    return apply


LITTLE = 1e-6
UNITS: Forgeries = {
    **{
        f"A[{i}][{j}] of states in other units is larger": (
            "rows",
            entry_of("system", "A", i, j, by=LITTLE * (1.0, 1e-3)[i] * (1.0, 1e3)[i]),
        )
        for i in range(2)
        for j in range(2)
    },
    **{f"B[{i}][{i}] is smaller": ("rows", entry_of("system", "B", i, i, times=1 - LITTLE)) for i in range(2)},
    **{f"x{i + 1}(0) is larger": ("rows", entry_of("initial_state", i, by=LITTLE)) for i in range(2)},
    **{
        f"the wall of x{i + 1} is nearer": ("rows", entry_of("terminal", 0, "box", i, times=1 - LITTLE))
        for i in range(2)
    },
    **{f"u{i + 1} costs more": ("rows", entry_of("weights", i, times=1 + 1e-9)) for i in range(2)},
    **{
        f"x{i + 1} is disturbed a little": (
            "rows",
            problem(disturbance={"box": [LITTLE * float(i == 0), LITTLE * float(i == 1)]}),
        )
        for i in range(2)
    },
    "the horizon is shorter": ("rows", entry_of("horizon", times=1 - LITTLE)),
    **{
        f"disturbance {i + 1} of the spring is larger": ("known", entry_of("disturbance", "box", i, times=1 + 1e-5))
        for i in range(2)
    },
    "the wall of the tiny problem is nearer": ("tiny", entry_of("terminal", 0, "box", 0, times=1 - LITTLE)),
    "the tiny problem begins further away": ("tiny", entry_of("initial_state", 0, times=1 + LITTLE)),
    "the parameter reaches further by a millionth": (
        "one parameter",
        entry_of("system", "parameters", "p1", 0, times=1 - LITTLE),
    ),
    **{
        f"row {i + 1} of the controls excludes them": ("rows", entry_of("control", "polytope", "h", i, times=0.01))
        for i in (1, 3, 4)
    },
}


def coefficient(piece: int, by: float) -> Change:
    """One piece of the control that brings a state to where it is fixed."""

    def apply(files: Forgery) -> None:
        files.decision[0][piece] += by
        horizon, pieces = float(files.problem["horizon"]), len(files.decision[0])
        files.certificate["cost"] = math.fsum(map(abs, files.decision[0])) * horizon / pieces

    return apply


EQUALITIES: Forgeries = {
    **{
        f"the fixed state is missed by 3e-10, by piece {k}": ("equality", coefficient(k, 1e-9)) for k in range(0, 10, 3)
    },
    "the fixed state is to be elsewhere by 1e-9": ("equality", problem(terminal=[{"equals": [None, None, 1e-9]}])),
    "a multiplier of the equality is too many": (
        "equality",
        lambda files: files.multipliers["equalities"].append(0.0),
    ),
    "the multiplier of the equality has the other sign": (
        "equality",
        lambda files: files.multipliers.update(equalities=[-nu for nu in files.multipliers["equalities"]]),
    ),
}


def normals(value: Any) -> Change:
    return lambda files: files.proof("terminal").update(normals=value)


DIRECTIONS: Forgeries = {
    "the directions lie on a line": ("ellipsoidal", normals([[1.0, 0.5], [2.0, 1.0]])),
    "the directions are none": ("ellipsoidal", normals([[0.0, 0.0], [0.0, 0.0]])),
    "there are too few directions": ("ellipsoidal", normals([[1.0, 0.0]])),
    "the directions are not finite": ("ellipsoidal", normals([[1.0, 0.0], [0.0, math.inf]])),
    "the directions are text": ("ellipsoidal", normals("all")),
    "a constraint has the direction of another row": (
        "rows",
        lambda files: files.heaviest.update(direction=[0.5 * c for c in files.heaviest["direction"]][::-1]),
    ),
    "a direction is longer by a thousandth, its multiplier is not": (
        "rows",
        lambda files: files.heaviest.update(direction=[1.001 * c for c in files.heaviest["direction"]]),
    ),
}
SUBTLE: dict[str, Forgeries] = {
    "every component": COMPONENTS,
    "every figure": FIGURES,
    "every window": CELLS,
    "every piece of the witness": WITNESSES,
    "every unit": UNITS,
    "every equality": EQUALITIES,
    "every direction": DIRECTIONS,
}
