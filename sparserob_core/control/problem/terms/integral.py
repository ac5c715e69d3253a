"""Bounds of integrals of state and control over windows of time: terms of a problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self, final

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.control.problem.terms.windows import (
    PathConstraint,
    Setting,
    Window,
    at_corners,
    coefficients,
    end_of,
)
from sparserob_core.control.term import SAME_TIME, TIME, UNITLESS, measured, over
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, Box, as_bound


@dataclass(frozen=True, eq=False)
class IntegralConstraint(Window):
    """A constraint ``lower <= int_start^stop (H x(t) + G u(t)) dt <= upper`` on integrals of state and control, row by
    row.

    Examples of such integrals are the fuel of a channel, the energy of a battery, and a mean temperature.

    Parameters
    ----------
    H : array (r, d), optional
        The coefficients of the state; 0 unless given.
    G : array (r, m), optional
        The coefficients of the control; 0 unless given. At least one of ``H`` and ``G`` is given.
    lower, upper : float or array (r,), optional
        The bounds; a number holds for all rows. There is no bound where one is infinite or ``None``.
    start : float, default 0.0
        The time at which the window begins, in the time unit of the system.
    stop : float, optional
        The time at which the window ends; the horizon unless given.
    name : str, optional
        The name in messages, tables and figures.

    Raises
    ------
    InputError
        When a problem is made with a constraint that does not fit it.

    Notes
    -----
    ``u(t)`` is the commanded control, even where the system has a delay. The integral from ``start`` on is one more
    state for each row, which is not measured.

    Examples
    --------
    >>> import sparserob_core as sr
    >>> sr.IntegralConstraint(G=[[1]], upper=0.5, stop=4.0, name="fuel").name
    'fuel'
    """

    H: npt.ArrayLike | None = field(default=None, metadata=measured(lambda of: 1.0 / (of.states * of.time)))
    G: npt.ArrayLike | None = field(default=None, metadata=measured(lambda of: 1.0 / (of.controls * of.time)))
    lower: npt.ArrayLike | Sequence[float | None] | None = field(default=None, metadata=UNITLESS)
    upper: npt.ArrayLike | Sequence[float | None] | None = field(default=None, metadata=UNITLESS)
    start: float = field(default=0.0, metadata=TIME)
    stop: float | None = field(default=None, metadata=TIME)
    name: str | None = field(default=None, metadata=UNITLESS)

    among = "integral"

    __repr__ = noun

    def checked(self, where: str, setting: Setting) -> Self:
        matrices = {"H": (self.H, setting.states, "state"), "G": (self.G, setting.controls, "control")}
        present = {name: entry for name, entry in matrices.items() if entry[0] is not None}
        arrays = dict(zip(present, coefficients(where, **present), strict=True))
        if len({len(rows) for rows in arrays.values()}) != 1:
            got = " and ".join(f"{len(rows)} in {name}" for name, rows in arrays.items()) or "neither"
            raise InputError(path=where, expected="H, or G, or both with as many rows", got=got)
        count = len(next(iter(arrays.values())))
        H, G = (arrays.get(name, np.zeros((count, width))) for name, (_, width, _) in matrices.items())
        if (empty := np.flatnonzero(~np.hstack([H, G]).any(axis=1))).size:
            raise InputError(path=where, expected="rows that integrate something", got=f"zeros in row {empty[0] + 1}")
        lower, upper = _check_limits(where, self, count)
        horizon, delay = setting.horizon, setting.delay
        start, stop = float(self.start), end_of(self.stop, horizon)
        if not (0.0 <= start < stop - SAME_TIME * horizon and stop <= horizon):
            raise InputError(
                path=where,
                expected=f"0 <= from < to <= {horizon:g} (the horizon), apart by more than rounding",
                got=f"from {start:g} to {stop:g}",
            )
        if delay > 0.0 and G.any() and stop + delay > horizon * (1.0 + SAME_TIME):
            raise InputError(
                path=f"{where}.to",
                expected=f"at most {horizon - delay:g}, the horizon less the delay, where G is not 0: a control"
                " that is commanded later never acts",
                got=f"{stop:g}",
            )
        return replace(self, H=H, G=G, lower=lower, upper=upper, start=start, stop=stop)

    def remaining(self, begin: float, horizon: float, **given: Any) -> Self | None:
        constraint = super().remaining(begin, horizon, **given)
        if constraint is not None and (self.start < begin or not over(self.stop or 0.0, begin + horizon)):
            raise InputError("a part of an integral is known as a state only: see `accumulated`", path="integral")
        return constraint

    @property
    def bounds(self) -> Box:
        return Box(np.asarray(self.lower), np.asarray(self.upper))

    def everywhere(self, corners: Sequence[Array]) -> Self:
        """Return the constraint on a larger state ``z`` that holds for all states ``x = corner z``.

        Parameters
        ----------
        corners : sequence of arrays (d, size)
            The matrices that give the states of the user at each corner of the parameters.
        """
        ends = np.column_stack([np.asarray(side, dtype=float) for side in (self.lower, self.upper)])
        H, G, sides = at_corners(corners, np.asarray(self.H), np.asarray(self.G), ends)
        return replace(self, H=H, G=G, lower=sides[:, 0], upper=sides[:, 1])

    def scaled(self, factor: float) -> Self:
        box = self.bounds.scaled(factor)
        return replace(self, lower=box.lower, upper=box.upper)


@final
@dataclass(frozen=True, eq=False)
class Accumulated(PathConstraint):
    """An `IntegralConstraint` in a problem where the integral is a state: a constraint on this state at one time."""

    stated = False


def _check_limits(where: str, entry: IntegralConstraint, count: int) -> tuple[Array, Array]:
    """Return the lower and upper bounds ``(r,)`` of an integral, infinite where there is none; raise `InputError`."""
    sides = []
    for name, bound, infinity in (("lower", entry.lower, -np.inf), ("upper", entry.upper, np.inf)):
        filled = [infinity if v is None else v for v in bound] if isinstance(bound, list | tuple) else bound
        sides.append(as_bound(f"{where}.{name}", infinity if filled is None else filled, count))
    lower, upper = sides
    if not (lower <= upper).all() or np.isposinf(lower).any() or np.isneginf(upper).any():
        got = f"{lower.tolist()} and {upper.tolist()}"
        raise InputError(path=where, expected="lower bounds that are no larger than the upper ones", got=got)
    if (np.isinf(lower) & np.isinf(upper)).any():
        raise InputError(path=where, expected="a lower or an upper bound of every row", got="a row without one")
    return lower, upper
