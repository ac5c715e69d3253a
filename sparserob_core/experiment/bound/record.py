"""The records of worst cases, in the user's terms, with their distance from the constraint."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, final

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.studies.suprema import BoundedRow, Sense
from sparserob_core.experiment.directory.artefacts import UNWRITTEN, finite
from sparserob_core.shapes import sealed
from sparserob_core.sip.convex_set import Array


@final
@dataclass(frozen=True, eq=False)
class WorstCase:
    """The supremum or infimum of a quantity over every disturbance, initial state and parameter, and over a window of
    time.

    It lies between ``lower`` and ``upper``. The lower bound of a supremum is reached by a witness, and its upper bound
    is proven over the continuum. For an infimum it is the other way round. A bound that is not known is infinite.

    Parameters
    ----------
    constraint, quantity, unit : str
        The constraint of the row, the quantity, and its unit.
    sense : {"sup", "inf"}
        Supremum or infimum.
    lower, upper : float
        The two bounds.
    time : float
        The time of the witness.
    wall : float or None
        The bound of the ``constraint`` on the quantity; ``None`` where there is none.
    margin : float or None
        The least distance of the proven side from the wall, negative where it is beyond; ``None`` without a wall.
    start, stop : float
        The window of time.
    direction : array
        The normal of the row, which points outwards.
    parameter : array (nu,)
        The parameter of the witness.
    deviation : array (d,)
        The deviation of its initial state from the centre of the initial states.
    changes : array (M + 1,)
        The times between which its disturbance is constant.
    disturbance : array (mw, M) or None
        Its disturbance; ``None`` where there is none.
    cells : int
        The number of cells that were examined.
    reason : str
        The reason why the two bounds are not as close as the tolerance asks.
    edges : array (n + 1,)
        The ends of parts of the window.
    low, high : array (n,)
        The bounds of the worst case on each of these parts.
    corner : str, default ""
        For parameters of a system whose matrices depend on the time, the corner of this worst case, such as ``gain =
        0.1``. `Bound.over_parameters` has the worst of all corners.
    stated : array, optional
        The direction without the coordinates that these parameters add to the states.
    """

    constraint: str
    quantity: str
    unit: str
    sense: Sense
    lower: float
    upper: float
    time: float
    wall: float | None
    margin: float | None
    start: float
    stop: float
    direction: Array
    parameter: Array
    deviation: Array
    changes: Array
    disturbance: Array | None
    cells: int
    reason: str
    edges: Array = field(repr=False, metadata=UNWRITTEN)
    low: Array = field(repr=False, metadata=UNWRITTEN)
    high: Array = field(repr=False, metadata=UNWRITTEN)
    corner: str = ""
    stated: Array | None = field(default=None, repr=False)

    __repr__ = brief

    def __post_init__(self) -> None:
        sealed(self)

    @property
    def reached(self) -> float:
        """The bound that a witness reaches."""
        return self.lower if self.sense == "sup" else self.upper

    @property
    def proven(self) -> float:
        """The bound that is proven over the continuum."""
        return self.upper if self.sense == "sup" else self.lower


def worst_case(problem: OptimalControlProblem, found: BoundedRow) -> WorstCase:
    """Return a bounded row in the user's terms: for a row that bounds a quantity from below, its infimum."""
    row, sign, corners = found.row, found.row.sign, problem.names.corners
    sides = [sign * found.lower, sign * found.upper]
    bands = [sign * found.low, sign * found.high]
    if row.sense == "inf":
        sides, bands = sides[::-1], bands[::-1]
    wall = sign * row.wall if np.isfinite(row.wall) else None
    return WorstCase(
        constraint=row.constraint,
        quantity=row.quantity(problem),
        unit=row.unit(problem),
        sense=row.sense,
        lower=sides[0],
        upper=sides[1],
        time=found.time,
        wall=wall,
        margin=None if wall is None else row.wall - found.upper,
        start=row.start,
        stop=row.stop,
        direction=row.direction,
        parameter=found.parameter,
        deviation=found.deviation,
        changes=found.changes,
        disturbance=found.disturbance,
        cells=found.cells,
        reason=found.reason,
        edges=found.edges,
        low=bands[0],
        high=bands[1],
        corner=corners.at(row.direction) or "",
        stated=corners.without(row.direction) if corners else None,
    )


def _merge_corners(rows: list[WorstCase]) -> WorstCase:
    """Return the worst case of one quantity over all corners of the parameters, with the witness of the worst
    corner."""
    is_supremum = rows[0].sense == "sup"
    extremum, elementwise_extremum = (max, np.maximum) if is_supremum else (min, np.minimum)
    worst = extremum(rows, key=lambda row: row.reached)
    return replace(
        worst,
        lower=extremum(row.lower for row in rows),
        upper=extremum(row.upper for row in rows),
        margin=None if worst.margin is None else min(row.margin for row in rows if row.margin is not None),
        cells=sum(row.cells for row in rows),
        reason="; ".join(dict.fromkeys(row.reason for row in rows if row.reason)),
        low=elementwise_extremum.reduce([row.low for row in rows]),
        high=elementwise_extremum.reduce([row.high for row in rows]),
    )


@final
@dataclass(frozen=True, eq=False)
class Bound:
    """The worst cases of a problem, without any control or with that of a run.

    Parameters
    ----------
    title : str
        The title of the experiment.
    status : {"certified", "undecided"}
        ``certified``: the two bounds of every row are as close as the ``tolerance`` asks. ``undecided``: those of some
        rows are further apart, and hold all the same.
    rows : tuple of WorstCase
        The worst cases.
    tolerance : float
        The distance of the bounds that was asked for. It is relative to the worst case, or to a thousandth of the
        largest value of the row where that is larger.
    decision : array (m, N) or None
        The coefficients of the run's control; ``None`` without a control.
    seconds : float
        The seconds that it has taken.
    directory : Path, optional
        The directory that was written, if there is one.
    remarks : tuple of str, default ()
        Warnings.
    time_unit : str, default ""
        The unit of times, where it is known.
    """

    title: str
    status: Literal["certified", "undecided"]
    rows: tuple[WorstCase, ...]
    tolerance: float
    decision: Array | None
    seconds: float
    directory: Path | None = field(default=None, metadata=UNWRITTEN)
    remarks: tuple[str, ...] = ()
    time_unit: str = ""

    __repr__ = brief

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``bound.json``: every field but the directory and the envelopes."""
        return {"format": 1, **finite(self)}

    @property
    def over_parameters(self) -> tuple[WorstCase, ...]:
        """The worst cases of all quantities, each over all corners of the parameters; ``rows`` has every corner by
        itself."""
        groups: dict[tuple[object, ...], list[WorstCase]] = {}
        for row in self.rows:
            direction = row.direction if row.stated is None else row.stated
            groups.setdefault((row.constraint, row.wall, row.start, row.stop, direction.tobytes()), []).append(row)
        return tuple(_merge_corners(rows) for rows in groups.values())


ENVELOPE = ("edges", "low", "high")


def envelopes(bound: Bound) -> dict[str, Array]:
    """Return the bounds of every worst case along its window, as arrays."""
    return {f"{name}{i}": getattr(row, name) for i, row in enumerate(bound.rows) for name in ENVELOPE}


def list_bound_rows(found: Bound) -> list[tuple[str, ...]]:
    """Return every worst case as a row of a table, over all corners of the parameters, with the corner that
    reaches it."""
    rows = found.over_parameters
    cornered = any(row.corner for row in rows)

    def number(value: float | None, towards: float = 0.0) -> str:
        if value is None or not np.isfinite(value):
            return "-"
        if towards:  # rounded outwards, so that the number in the table is a bound too
            size = 10.0 ** (np.floor(np.log10(abs(value))) - 8.0) if value else 0.0
            value += 0.0 if (float(f"{value:.9g}") - value) * towards >= 0.0 else towards * 0.5 * size
        return f"{value:.9g}"

    return [
        (
            row.constraint,
            f"{row.sense} {row.quantity}" + (f" [{row.unit}]" if row.unit else ""),
            number(row.lower, -1.0),
            number(row.upper, 1.0),
            f"{row.time:.6g}",
            number(row.wall),
            "-" if row.margin is None or not np.isfinite(row.margin) else f"{row.margin:.4g}",
            *([row.corner or "-"] if cornered else []),
        )
        for row in rows
    ]


def list_bound_columns(found: Bound) -> tuple[str, ...]:
    """Return the names of the columns of `list_bound_rows`."""
    time = f"at t [{found.time_unit}]" if found.time_unit else "at t"
    corner_column = ("at parameters",) if any(row.corner for row in found.rows) else ()
    return "constraint", "worst case", "at least", "at most", time, "wall", "margin", *corner_column
