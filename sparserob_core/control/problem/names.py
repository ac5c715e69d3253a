"""The names and the units of the states, controls and disturbances of a problem."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

KINDS = {"states": "x", "controls": "u", "disturbances": "w"}
# Relative to the largest entry of a direction; the order of summation changes a product by less
NEGLIGIBLE_DIRECTION_ENTRY = 1e-12


@final
@dataclass(frozen=True, eq=False)
class Corners:
    """The corners of the box of parameters, for a system that depends on the time and on parameters.

    The state of such a problem is larger: it holds further states, by which the parameters act. At each corner one
    matrix gives the states of the user from the larger state (`at_corners`). Without such parameters all fields are
    empty.

    Parameters
    ----------
    rows : list of arrays (d, size)
        The matrix of each corner: the identity, and the factors of the further states.
    values : array (k, nu)
        The parameters at each corner.
    names : sequence of str
        The names of the parameters.
    """

    rows: list[Array] = field(default_factory=list)
    values: Array = field(default_factory=lambda: np.zeros((0, 0)))
    names: Sequence[str] = ()

    def __bool__(self) -> bool:
        return bool(self.rows)

    @property
    def added(self) -> tuple[int, int]:
        """The index of the first state that parameters add, and the index after the last of these states."""
        d, size = self.rows[0].shape if self.rows else (0, 0)
        return d, size

    def everywhere(self, directions: Array) -> tuple[np.ndarray, Array]:
        """Return directions at every corner of the parameters.

        Parameters
        ----------
        directions : array (q, n)
            The directions in the ``n`` states of the larger problem.

        Returns
        -------
        numbers : array (k,)
            The index of the direction to which each row belongs.
        rows : array (k, n)
            The directions with their components along the states that parameters add. A direction that no parameter
            changes occurs once.
        """
        if not self.rows:
            return np.arange(len(directions)), directions
        d, size = self.added
        at_corners = np.repeat(directions[:, None], len(self.rows), axis=1)
        at_corners[:, :, d:size] += np.stack([directions[:, :d] @ corner[:, d:] for corner in self.rows], axis=1)
        distinct = [np.unique(rows, axis=0) for rows in at_corners]
        return np.repeat(np.arange(len(distinct)), [len(rows) for rows in distinct]), np.concatenate(distinct)

    def without(self, direction: Array) -> Array:
        """Return a direction whose components along the states that parameters add are 0."""
        d, size = self.added
        return np.concatenate([direction[:d], np.zeros(size - d), direction[size:]])

    def own(self, states: int) -> list[int]:
        """Return the indices of those of ``states`` states that no parameter added.

        The tubes of the returned states contain the effect of the parameters.
        """
        d, size = self.added
        return [*range(d), *range(size, states)]

    def select_corner(self, direction: Array, states: Array) -> Array:
        """Return trajectories of which the first ``d`` states are those at the corner of a direction.

        Parameters
        ----------
        direction : array (n,)
            The direction in the ``n`` states of the larger problem; the corner that fits it best is used.
        states : array (n, T)
            The trajectories of these states at ``T`` times.

        Returns
        -------
        array (n, T)
            The trajectories; where there are no corners, they are returned as they are.
        """
        if not self.rows:
            return states
        d, size = self.added
        corner = min(self.rows, key=lambda matrix: np.abs(direction[:d] @ matrix[:, d:] - direction[d:size]).sum())
        return np.concatenate([corner @ states[:size], states[d:]])

    def at(self, direction: Array) -> str | None:
        """Return the parameters to whose corner a direction belongs, such as ``gain = 0.1``.

        Returns
        -------
        str or None
            The parameters whose value the direction determines, in words; empty where it determines none. ``None``
            where the direction belongs to no corner.
        """
        if not self.rows:
            return None
        d, size = self.added
        components, largest = np.array([direction[:d] @ corner[:, d:] for corner in self.rows]), np.abs(direction).max()
        matches = (
            np.abs(components - direction[d:size]).max(axis=1, initial=0.0) <= NEGLIGIBLE_DIRECTION_ENTRY * largest
        )
        if not matches.any():
            return None
        values = self.values[matches]
        determined = (values == values[:1]).all(axis=0) & (self.values != values[:1]).any(axis=0)
        return ", ".join(
            f"{name} = {v:.6g}"
            for name, v, is_determined in zip(self.names, values[0], determined, strict=True)
            if is_determined
        )


@final
@dataclass(frozen=True, kw_only=True)
class Names:
    """The names and units of states, controls and disturbances, for messages, tables, figures and recordings.

    Names and units change no number.

    Parameters
    ----------
    states, controls, disturbances : sequence of str, optional
        One name each; ``x1``, ``u1``, ``w1`` and so on unless given.
    state_units, control_units, disturbance_units : sequence of str, optional
        One unit each, such as ``m/s``; an empty text where a unit is not known. No units are known unless given.
    time : str, default ""
        The unit of time.
    plane : sequence of two str, optional
        The names of two states that are a position, for a figure of the path in the plane. The first one is drawn to
        the right, the second one upwards.
    corners : Corners
        The corners of the parameters, by which a larger problem is reported in the states of the user. Users do not
        give them.

    Raises
    ------
    InputError
        If a name is empty or occurs twice, or if ``plane`` does not name two different states with the same unit.

    Examples
    --------
    >>> import sparserob_core as sr
    >>> names = sr.Names(states=["position", "speed"], state_units=["m", "m/s"], time="s")
    >>> names.state(1)
    'speed'
    """

    states: Sequence[str] = ()
    controls: Sequence[str] = ()
    disturbances: Sequence[str] = ()
    state_units: Sequence[str] = ()
    control_units: Sequence[str] = ()
    disturbance_units: Sequence[str] = ()
    time: str = ""
    plane: Sequence[str] = ()
    corners: Corners = field(default_factory=Corners, repr=False, compare=False)

    __repr__ = noun

    def __post_init__(self) -> None:
        kind_of: dict[str, str] = {}
        for kind in KINDS:
            names = self._check_texts(kind)
            for name in names:
                if not name.strip():
                    raise InputError(path=f"names.{kind}", expected="names that are not empty", got=f"{list(names)}")
                if name in kind_of:
                    also = f" and in {kind_of[name]}" if kind_of[name] != kind else ""
                    raise InputError(f"the name {name!r} occurs twice, in {kind}{also}", path="names")
                kind_of[name] = kind
            self._check_texts(f"{kind[:-1]}_units")
        if not isinstance(self.time, str):
            raise InputError(path="names.units.time", expected="a text such as s", got=f"{self.time!r}")
        if plane := self._check_texts("plane"):
            expected = "two of the states" + (f", {', '.join(self.states)}" if self.states else ", such as x1 and x2")
            indices = [self._find_state(name) for name in plane]
            if len(plane) != 2 or plane[0] == plane[1] or None in indices:
                raise InputError(path="names.plane", expected=expected, got=f"{list(plane)}")
            units = [
                self.state_units[index] for index in indices if index is not None and index < len(self.state_units)
            ]
            if len(set(units)) > 1:
                raise InputError(path="names.plane", expected="two states of the same unit", got=" and ".join(units))

    @property
    def in_plane(self) -> tuple[int, int] | None:
        """The indices of the two states that are a position in the plane; ``None`` where none are given."""
        horizontal, vertical = [self._find_state(name) for name in self.plane] or [None, None]
        return None if horizontal is None or vertical is None else (horizontal, vertical)

    def _find_state(self, name: str) -> int | None:
        """Return the index of the state with a name, or ``None`` where no state has it."""
        if self.states:
            return self.states.index(name) if name in self.states else None
        return int(name[1:]) - 1 if re.fullmatch("x[1-9][0-9]*", name) else None

    def fitting(self, states: int, controls: int, disturbances: int) -> Names:
        """Return the names themselves, after a check of their number.

        Parameters
        ----------
        states, controls, disturbances : int
            The numbers of states, controls and disturbances of the problem.

        Raises
        ------
        InputError
            If the number of names or units of a kind is another one.
        """
        for kind, count in (("states", states), ("controls", controls), ("disturbances", disturbances)):
            for key, texts in ((kind, getattr(self, kind)), (f"units.{kind}", getattr(self, f"{kind[:-1]}_units"))):
                if texts and len(texts) != count:
                    raise InputError(
                        path=f"names.{key}",
                        expected=f"{count}, one for each of the {kind}",
                        got=f"{len(texts)}: {', '.join(texts)}",
                    )
        if (indices := self.in_plane) is not None and max(indices) >= states:
            raise InputError(path="names.plane", expected=f"two of {states} states", got=f"{list(self.plane)}")
        return self

    def state(self, index: int) -> str:
        """Return the name of the state with an index from 0 on, such as ``x1``."""
        return self.states[index] if self.states else f"x{index + 1}"

    def control(self, index: int) -> str:
        """Return the name of the control with an index from 0 on, such as ``u1``."""
        return self.controls[index] if self.controls else f"u{index + 1}"

    def disturbance(self, index: int) -> str:
        """Return the name of the component of the disturbance with an index from 0 on, such as ``w1``."""
        return self.disturbances[index] if self.disturbances else f"w{index + 1}"

    @property
    def effort(self) -> str:
        """The unit of the integral of a control over time; empty where it is not known or controls differ in unit.

        The time of a rate cancels: ``l/s`` over ``s`` is ``l``, and ``m/s^2`` over ``s`` is ``m/s``.
        """
        unit = next(iter(self.control_units), "")
        if not unit or not self.time or set(self.control_units) != {unit}:
            return ""
        for rate, suffix in ((f"/{self.time}^2", f"/{self.time}"), (f"/{self.time}", "")):
            if unit.endswith(rate) and len(unit) > len(rate):
                return unit.removesuffix(rate) + suffix
        return f"{unit} {self.time}"

    def _check_texts(self, field: str) -> tuple[str, ...]:
        """Return a field as a tuple of texts, which is kept; raise `InputError` for anything else."""
        texts = getattr(self, field)
        if isinstance(texts, str) or not all(isinstance(text, str) for text in texts):
            raise InputError(path=f"names.{field}", expected="a list of texts", got=f"{texts!r}")
        object.__setattr__(self, field, tuple(texts))
        return tuple(texts)


UNNAMED = Names()


def measured_in(normal: npt.NDArray[np.float64], names: Names, states: int | None = None) -> str:
    """Return the unit of a linear combination, with a space before it, where all its summands have the same unit.

    Parameters
    ----------
    normal : array (n,)
        The coefficients of the states, followed by those of the controls.
    names : Names
        The names and units.
    states : int, optional
        The number of states; all coefficients belong to states unless given.

    Returns
    -------
    str
        The unit; empty where the summands differ in unit or a unit is not known.
    """
    last = normal.size if states is None else states
    units = {
        (names.state_units[i] if names.state_units else "")
        if i < last
        else (names.control_units[i - last] if names.control_units else "")
        for i in np.flatnonzero(normal).tolist()
    }
    unit = units.pop() if len(units) == 1 else ""
    return f" {unit}" if unit else ""


def unit_of_row(normal: npt.NDArray[np.float64], names: Names, states: int | None = None) -> str:
    """Return the unit of a row as the user wrote it, with a space before it; empty where it is not known.

    Coefficients may have units, as stiffnesses do. They are pure numbers where one of them is 1 in absolute value, or
    where the row is a direction of length 1. For other coefficients the unit of the row is not known.

    Parameters
    ----------
    normal : array (n,)
        The coefficients of the states, followed by those of the controls.
    names : Names
        The names and units.
    states : int, optional
        The number of states; all coefficients belong to states unless given.
    """
    sizes = np.abs(normal)
    numbers = (sizes == 1.0).any() or abs(np.linalg.norm(sizes) - 1.0) <= NEGLIGIBLE_DIRECTION_ENTRY
    return measured_in(normal, names, states) if numbers else ""


def join_units(units: Iterable[str]) -> str:
    """Return the unit of a number that belongs to one of several rows, with a space before it.

    The result is ``m`` where all rows have this unit, ``m or m/s`` where rows differ, and empty where a unit is not
    known.
    """
    distinct = list(dict.fromkeys(units))
    return f" {' or '.join(distinct)}" if distinct and all(distinct) else ""
