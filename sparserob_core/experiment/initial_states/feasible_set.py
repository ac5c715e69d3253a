"""The record of a set of feasible initial states: two polygons, one within and one around it, and costs between."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import brief
from sparserob_core.control.problem.names import UNNAMED, Names
from sparserob_core.control.studies.polygon_approximation import inside, polygon_area
from sparserob_core.errors import InputError
from sparserob_core.quantities import quantities, quantity
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.result import Status

BOUND_ROUNDING = 1e-12  # of a bound
ON_EDGE = 1e-9  # of the polygon's size, a distance that is on the edge


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class InitialStates:
    """The convex set of initial states from which some control satisfies every constraint, in the plane of the states
    ``states`` (from 0).

    ``inner (k, 2)`` and ``outer (k', 2)``: vertices, anticlockwise, of a polygon proven to lie within the set and of
    one proven to contain it, in the units of the states. ``controls (k, m, K)``: a control for each vertex of
    ``inner``; between them, convex combinations serve. Under feedback these are the nominal ones, with the ``gains (k,
    K, K, m, d)`` of their policies, and the set is that from which some affine policy satisfies every constraint.
    ``inner_gains (K, m, d)``: those of an inner loop, the same for all, by which the control answers how far the state
    is from the nominal one.
    ``directions (n, 2)`` with ``bounds (n,)``: half-planes
    ``d'x <= bound`` that contain the set, and ``reached (n,)``: what proven points reach. ``points (v, 2)`` with
    ``costs (v,)``: initial states and the cost of a proven control from each, and ``lower_bounds (v,)`` of its optimum.
    ``origin (d,)``: the config's initial state; the coordinates that are not in the plane are as there. ``path``:
    sections of the path sets that hold at time 0. ``called``: the names of the states, ``cost_unit`` what the costs are
    measured in, where that is known. ``limit``: the bound on the coordinates where one was asked for, and ``cut``
    whether it cuts the set. ``status``: ``certified`` (the polygons differ by at most a thousandth of the area),
    ``verified`` (by more), ``infeasible`` (the set is empty, proven) or ``undecided`` (no point is proven).
    ``directory``: where its files are, if there are any.
    """

    title: str
    states: tuple[int, int]
    status: Status
    message: str
    inner: Array = field(default_factory=lambda: np.zeros((0, 2)), metadata=quantity("plane"))
    outer: Array = field(default_factory=lambda: np.zeros((0, 2)), metadata=quantity("plane"))
    controls: Array = field(default_factory=lambda: np.zeros((0, 0, 0)), repr=False, metadata=quantity("controls"))
    directions: Array = field(default_factory=lambda: np.zeros((0, 2)), repr=False, metadata=quantity("normals"))
    bounds: Array = field(default_factory=lambda: np.zeros(0), repr=False, metadata=quantity("bounds"))
    reached: Array = field(default_factory=lambda: np.zeros(0), repr=False, metadata=quantity("bounds"))
    points: Array = field(default_factory=lambda: np.zeros((0, 2)), repr=False, metadata=quantity("plane"))
    costs: Array = field(default_factory=lambda: np.zeros(0), repr=False, metadata=quantity("cost"))
    lower_bounds: Array = field(default_factory=lambda: np.zeros(0), repr=False, metadata=quantity("cost"))
    origin: Array = field(default_factory=lambda: np.zeros(0), metadata=quantity("states"))
    gains: Array = field(default_factory=lambda: np.zeros((0, 0, 0, 0, 0)), repr=False, metadata=quantity("gains"))
    inner_gains: Array = field(default_factory=lambda: np.zeros((0, 0, 0)), repr=False, metadata=quantity("gains"))
    path: Sequence[Array] = field(default=(), repr=False, metadata=quantity("plane"))
    called: Names = UNNAMED
    cost_unit: str = ""
    limit: float | None = None
    cut: bool = False
    remarks: Sequence[str] = ()
    programs: int = 0
    seconds: float = 0.0
    directory: Path | None = field(default=None, repr=False)

    __repr__ = brief

    @property
    def names(self) -> tuple[str, str]:
        """The two coordinates, such as ``x1(0)``."""
        return f"{self.called.state(self.states[0])}(0)", f"{self.called.state(self.states[1])}(0)"

    @property
    def units(self) -> tuple[str, str]:
        """Units of the two coordinates; empty where they are not known."""
        named = self.called.state_units
        return (named[self.states[0]], named[self.states[1]]) if named else ("", "")

    @property
    def start(self) -> Array:
        """The config's own initial state in the plane, ``(2,)``."""
        return np.asarray(self.origin[list(self.states)])

    @property
    def inner_area(self) -> float:
        """The area of the inner polygon."""
        return polygon_area(self.inner)

    @property
    def outer_area(self) -> float:
        """The area of the outer polygon."""
        return polygon_area(self.outer)

    @property
    def gap(self) -> float:
        """``(outer - inner) / outer`` of the areas; nan where the outer polygon has none."""
        return 1.0 - self.inner_area / self.outer_area if self.outer_area > 0.0 else np.nan

    def where(self, point: npt.ArrayLike) -> Literal["inside", "outside", "open"]:
        """Return whether a point ``(2,)`` is proven to be in the set, proven to be outside, or open between the
        polygons."""
        x = _check_point(point)
        if not self.outer.shape[0]:
            return "outside" if self.status == "infeasible" else "open"
        term_sizes = np.abs(self.directions) @ np.abs(self.outer).max(axis=0)  # what is added up to a bound
        if (self.directions @ x > self.bounds + BOUND_ROUNDING * np.maximum(term_sizes, np.abs(self.bounds))).any():
            return "outside"
        return "inside" if self.inner.shape[0] > 2 and bool(inside(self.inner, x[None])[0]) else "open"

    def cost(self, point: npt.ArrayLike) -> float:
        """A proven upper bound of the optimal cost from a point ``(2,)``: the optimal cost is convex, so the least
        combination of measured costs that has the point as its mean is one (a linear program); infinite outside of the
        measured points."""
        weights = _find_combination(self.points, _check_point(point), self.costs)
        return np.inf if weights is None else float(weights @ self.costs)

    def control(self, point: npt.ArrayLike) -> Array:
        """A control ``(m, K)`` that is proven for the initial state at a point ``(2,)`` of the inner polygon, under
        feedback the nominal one of `policy`; raises `InputError` outside."""
        return np.asarray(np.tensordot(self._find_weights(point), self.controls, axes=1))

    def policy(self, point: npt.ArrayLike) -> tuple[Array, Array]:
        """The nominal control ``(m, K)`` and the gains ``(K, K, m, d)`` of a policy that is proven for the initial
        state at a point ``(2,)`` of the inner polygon; raises `InputError` outside, and without feedback."""
        if not self.gains.size:
            raise InputError("policy: expected a set that was found with policy: affine; without, use control")
        return self.control(point), np.asarray(np.tensordot(self._find_weights(point), self.gains, axes=1))

    def _find_weights(self, point: npt.ArrayLike) -> Array:
        x = _check_point(point)
        weights = _find_combination(self.inner, x, np.zeros(self.inner.shape[0]))
        if weights is None:
            raise InputError(f"point: expected one in the inner polygon, got {x.tolist()}")
        return weights

    def summary(self) -> dict[str, Any]:
        """``initial_states.json``."""
        return {
            "title": self.title,
            "status": self.status,
            "message": self.message,
            "states": [state + 1 for state in self.states],
            "inner_area": self.inner_area,
            "outer_area": self.outer_area,
            "gap": self.gap,
            "inner": self.inner,
            "outer": self.outer,
            "initial_state": self.origin,
            "initial_state_is": self.where(self.start),
            "directions": len(self.bounds),
            "values": len(self.costs),
            "least_cost": self.costs.min(initial=np.inf),
            "greatest_cost": self.costs.max(initial=-np.inf),
            "cost_unit": self.cost_unit,
            "limit": self.limit,
            "cut": self.cut,
            "remarks": list(self.remarks),
            "programs": self.programs,
            "seconds": self.seconds,
        }

    def arrays(self) -> Mapping[str, Array]:
        """``initial_states.npz``."""
        arrays = {name: getattr(self, name) for name in quantities(InitialStates) if name != "path"}
        return {name: array for name, array in arrays.items() if array.size or not name.endswith("gains")}

    def rows(self) -> list[tuple[str, str]]:
        """Return the main results for a user, as rows of a table."""
        rows = [("status", f"{self.status}: {self.message}")]
        if self.outer.shape[0]:
            rows += [
                ("coordinates", " and ".join(self.names)),
                ("area", f"at least {self.inner_area:.6g}, at most {self.outer_area:.6g}"),
                *(
                    (name, f"from {low:.6g} to {high:.6g} {unit}".rstrip())
                    for name, low, high, unit in zip(
                        self.names, self.outer.min(axis=0), self.outer.max(axis=0), self.units, strict=True
                    )
                ),
                ("directions", str(len(self.bounds))),
            ]
            rows += (
                [("costs", f"{len(self.costs)}, from {self.costs.min():.6g} to {self.costs.max():.6g}")]
                if self.costs.size
                else []
            )
            outside = "no affine policy, proven" if self.gains.size else "infeasible, proven"
            text = {"inside": "feasible, proven", "outside": outside, "open": "between the polygons"}[
                self.where(self.start)
            ]
            rows += [("the config's own", f"({self.start[0]:.6g}, {self.start[1]:.6g}): {text}")]
        return [*rows, ("seconds", f"{self.seconds:.3f}")]


def _check_point(point: npt.ArrayLike) -> Array:
    try:
        x = np.asarray(point, dtype=float)
    except (TypeError, ValueError):
        x = np.zeros(0)
    if x.shape != (2,) or not np.isfinite(x).all():
        raise InputError(f"point: expected two finite numbers, got {point!r}")
    return x


def _find_combination(points: Array, x: Array, costs: Array) -> Array | None:
    """The cheapest weights ``(k,)``, at least 0 and of sum 1, with ``weights @ points = x``; ``None`` when there are
    none."""
    from scipy.optimize import linprog

    if not points.shape[0]:
        return None
    size = np.abs(points).max(axis=0)  # of each coordinate: they have different units
    size = np.where(size > 0.0, size, 1.0)
    price = float(np.abs(costs).max(initial=0.0)) or 1.0
    rows = np.vstack([(points / size).T, np.ones(points.shape[0])])
    solution = linprog(costs / price, A_eq=rows, b_eq=np.append(x / size, 1.0))
    residual = np.inf if solution.status else np.abs((solution.x @ points - x) / size).max()
    return np.asarray(solution.x) if residual <= ON_EDGE else None
