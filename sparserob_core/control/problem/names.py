"""What the states, controls and disturbances of a problem are called, and what they are measured in."""

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
ROUNDING = 1e-12  # of the largest entry of a direction: products that are added up in another order differ by less


@final
@dataclass(frozen=True, eq=False)
class Corners:
    """The corners of the parameters beside the time, one row of the larger problem each (`at_corners`), with the
    ``values (k, nu)`` of the parameters called ``names``; none where there are no such parameters."""

    rows: list[Array] = field(default_factory=list)
    values: Array = field(default_factory=lambda: np.zeros((0, 0)))
    names: Sequence[str] = ()

    def __bool__(self) -> bool:
        return bool(self.rows)

    @property
    def added(self) -> tuple[int, int]:
        """The first of the states that parameters add, and the one after the last of them."""
        d, size = self.rows[0].shape if self.rows else (0, 0)
        return d, size

    def everywhere(self, directions: Array) -> tuple[np.ndarray, Array]:
        """Rows ``(k, d)`` of ``directions (q, d)``, after the number of each, at every corner; one that looks at no
        state which the parameters reach is there once."""
        if not self.rows:
            return np.arange(len(directions)), directions
        d, size = self.added
        every = np.repeat(directions[:, None], len(self.rows), axis=1)
        every[:, :, d:size] += np.stack([directions[:, :d] @ one[:, d:] for one in self.rows], axis=1)
        kept = [np.unique(part, axis=0) for part in every]
        return np.repeat(np.arange(len(kept)), [len(part) for part in kept]), np.concatenate(kept)

    def without(self, direction: Array) -> Array:
        """A direction without what the parameters add to the states."""
        d, size = self.added
        return np.concatenate([direction[:d], np.zeros(size - d), direction[size:]])

    def own(self, states: int) -> list[int]:
        """Those of so many states that no parameter added: what parameters add is in the tubes of the others."""
        d, size = self.added
        return [*range(d), *range(size, states)]

    def stated(self, direction: Array, states: Array) -> Array:
        """Trajectories ``(n, T)`` of all states, with the first of them at the corner that a direction is nearest
        to."""
        if not self.rows:
            return states
        d, size = self.added
        corner = min(self.rows, key=lambda one: np.abs(direction[:d] @ one[:, d:] - direction[d:size]).sum())
        return np.concatenate([corner @ states[:size], states[d:]])

    def at(self, direction: Array) -> str | None:
        """The parameters whose corner a direction is about, such as ``gain = 0.1``; empty where it is about all,
        ``None`` where it is about none alone."""
        if not self.rows:
            return None
        d, size = self.added
        added, far = np.array([direction[:d] @ one[:, d:] for one in self.rows]), np.abs(direction).max()
        mine = np.abs(added - direction[d:size]).max(axis=1, initial=0.0) <= ROUNDING * far
        if not mine.any():
            return None
        values = self.values[mine]
        same = (values == values[:1]).all(axis=0) & (self.values != values[:1]).any(axis=0)
        return ", ".join(f"{name} = {v:.6g}" for name, v, told in zip(self.names, values[0], same, strict=True) if told)


@final
@dataclass(frozen=True, kw_only=True)
class Names:
    """Names and units for messages, tables, figures and recordings; they change no number.

    ``states``, ``controls``, ``disturbances``: one name each, or nothing: then they are ``x1``, ``u1``, ``w1`` and
    so on; ``state_units``, ``control_units``, ``disturbance_units``: one unit each, such as ``m/s`` (empty:
    none is known), and ``time`` the unit of time. ``plane``: the two states that are a place, first the one that is
    drawn to the right, then the one upwards, for a figure of where the system moves. ``corners``: of a problem that
    parameters beside the time made larger, by which its rows are told as those of the stated one. Raises `InputError`
    for a name that is empty or occurs twice, and for a plane that is none.
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
        seen: dict[str, str] = {}
        for kind in KINDS:
            names = self._texts(kind)
            for name in names:
                if not name.strip():
                    raise InputError(path=f"names.{kind}", expected="names that are not empty", got=f"{list(names)}")
                if name in seen:
                    also = f" and in {seen[name]}" if seen[name] != kind else ""
                    raise InputError(f"the name {name!r} occurs twice, in {kind}{also}", path="names")
                seen[name] = kind
            self._texts(f"{kind[:-1]}_units")
        if not isinstance(self.time, str):
            raise InputError(path="names.units.time", expected="a text such as s", got=f"{self.time!r}")
        if plane := self._texts("plane"):
            known = "two of the states" + (f", {', '.join(self.states)}" if self.states else ", such as x1 and x2")
            places = [self._place(name) for name in plane]
            if len(plane) != 2 or plane[0] == plane[1] or None in places:
                raise InputError(path="names.plane", expected=known, got=f"{list(plane)}")
            units = [self.state_units[place] for place in places if place is not None and place < len(self.state_units)]
            if len(set(units)) > 1:
                raise InputError(path="names.plane", expected="two states of the same unit", got=" and ".join(units))

    @property
    def in_plane(self) -> tuple[int, int] | None:
        """The positions of the two states that are a place; ``None`` where the problem has not said any."""
        across, up = [self._place(name) for name in self.plane] or [None, None]
        return None if across is None or up is None else (across, up)

    def _place(self, name: str) -> int | None:
        """The position of a state of that name."""
        if self.states:
            return self.states.index(name) if name in self.states else None
        return int(name[1:]) - 1 if re.fullmatch("x[1-9][0-9]*", name) else None

    def fitting(self, states: int, controls: int, disturbances: int) -> Names:
        """The same names, checked against how many there are; raises `InputError`."""
        for kind, count in (("states", states), ("controls", controls), ("disturbances", disturbances)):
            for key, given in ((kind, getattr(self, kind)), (f"units.{kind}", getattr(self, f"{kind[:-1]}_units"))):
                if given and len(given) != count:
                    raise InputError(
                        path=f"names.{key}",
                        expected=f"{count}, one for each of the {kind}",
                        got=f"{len(given)}: {', '.join(given)}",
                    )
        if (places := self.in_plane) is not None and max(places) >= states:
            raise InputError(path="names.plane", expected=f"two of {states} states", got=f"{list(self.plane)}")
        return self

    def state(self, index: int) -> str:
        """The name of a state, such as ``x1``."""
        return self.states[index] if self.states else f"x{index + 1}"

    def control(self, index: int) -> str:
        """The name of a control, such as ``u1``."""
        return self.controls[index] if self.controls else f"u{index + 1}"

    def disturbance(self, index: int) -> str:
        """The name of a component of the disturbance, such as ``w1``."""
        return self.disturbances[index] if self.disturbances else f"w{index + 1}"

    @property
    def effort(self) -> str:
        """The unit of a control's integral over time, where every control has the same; empty where it is not known. A
        rate's time cancels: ``l/s`` over ``s`` is ``l``, ``m/s^2`` over ``s`` is ``m/s``."""
        unit = next(iter(self.control_units), "")
        if not unit or not self.time or set(self.control_units) != {unit}:
            return ""
        for rate, left in ((f"/{self.time}^2", f"/{self.time}"), (f"/{self.time}", "")):
            if unit.endswith(rate) and len(unit) > len(rate):
                return unit.removesuffix(rate) + left
        return f"{unit} {self.time}"

    def _texts(self, field: str) -> tuple[str, ...]:
        given = getattr(self, field)
        if isinstance(given, str) or not all(isinstance(text, str) for text in given):
            raise InputError(path=f"names.{field}", expected="a list of texts", got=f"{given!r}")
        object.__setattr__(self, field, tuple(given))
        return tuple(given)


UNNAMED = Names()


def measured_in(normal: npt.NDArray[np.float64], names: Names, states: int | None = None) -> str:
    """The unit of a combination, with a space before it, where all that it adds up has the same; empty elsewhere. What
    is beyond the number of ``states`` is the control's."""
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

    Coefficients may have units themselves, as stiffnesses do. They are numbers where one of them is 1, or where they
    are a direction of length 1; of others the unit of the row is not known.
    """
    sizes = np.abs(normal)
    numbers = (sizes == 1.0).any() or abs(np.linalg.norm(sizes) - 1.0) <= ROUNDING
    return measured_in(normal, names, states) if numbers else ""


def joined(units: Iterable[str]) -> str:
    """The unit of a number that is one of several rows', with a space before it: ``m``, or ``m or m/s`` where rows have
    different ones; empty where one of them is not known."""
    known = list(dict.fromkeys(units))
    return f" {' or '.join(known)}" if known and all(known) else ""
