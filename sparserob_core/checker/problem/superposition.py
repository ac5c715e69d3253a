"""Parameters beside the time, as coordinates of a larger state: derived from the problem's records alone.

Where every entry of ``[A B E c]`` is a sum ``f_0(t) + sum_j f_j(t) s_j``, ``s_j`` what parameter ``j`` deviates from a
middle one by as a share of the most that it can, the state is ``x = x_0 + sum_j s_j y_j``, if no entry of ``A`` that
has an ``s_j`` meets a state that depends on a parameter: then ``y_j' = A_0 y_j + A_j x_0 + B_j u + E_j w + c_j``. After
the ``d`` states of the problem come the coordinates of ``y_1`` that anything moves, then those of ``y_2``, and so on.
Rows on ``x`` are affine in ``s``, and hold on a box where they hold at its corners, at which every ``s_j`` is -1 or 1;
so do convex sets.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import product
from math import inf, nextafter
from typing import TYPE_CHECKING, Any, TypeAlias, final

import numpy as np

from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.problem.integrals import with_zeros
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import LinearSystem, VaryingSystem
from sparserob_core.control.problem.terms.integral import IntegralConstraint
from sparserob_core.control.problem.terms.repeat import Return
from sparserob_core.control.problem.terms.windows import MixedConstraint
from sparserob_core.control.sets.sets import Box, ConvexSet, Cylinder, Equality, Polytope
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from sparserob_core.control.problem.terms.windows import PathConstraint

Level: TypeAlias = dict[tuple[int, ...], Any]
"""Parts of a power series, each times the shares whose numbers are its key."""

NAMES = ("A", "B", "E", "c")
FREE: tuple[int, ...] = ()  # the key of what no parameter multiplies; others are the numbers of those that do, in order
LARGEST_POWER = 64  # of a natural number, what is multiplied out
MOST_FACTORS = 8
"""Parameters of which one product may be made where entries are to be polynomials; expansions of such systems have
hundreds of parts, and where there are more factors an entry is as good as any other function."""


@final
class Something:
    """Any number at all, as a time of which nothing is known; nothing that is made of it counts as 0."""

    def _any(self, *_: object) -> Something:
        return self

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = __rtruediv__ = __pow__ = _any
    __rpow__ = __neg__ = __pos__ = sin = cos = tan = exp = sqrt = log = tanh = kepler = _any


@final
class Sum:
    """A power series in the shares ``s_j`` up to so many factors, ``most``: each of the ``parts`` times those whose
    numbers are its key; ``bent``: it is, or may be, more than that.

    Functions are made by the operator that multiplies a product by its number of factors, ``D = sum_j s_j d/ds_j``, for
    which ``D g(f) = g'(f) D f``: a part of ``g`` with ``n`` factors is a sum over those with fewer.
    """

    __slots__ = ("bent", "most", "parts")

    def __init__(self, parts: Level, most: int = MOST_FACTORS, bent: bool = False) -> None:
        self.parts, self.most, self.bent = parts, most, bent

    @property
    def is_free(self) -> bool:
        return not self.bent and self.parts.keys() == {FREE}

    def _of(self, other: object) -> Sum:
        return other if isinstance(other, Sum) else Sum({FREE: other}, self.most)

    def __add__(self, other: object) -> Sum:
        more, parts = self._of(other), dict(self.parts)
        for key, value in more.parts.items():
            parts[key] = parts[key] + value if key in parts else value
        return Sum(parts, self.most, self.bent or more.bent)

    def __neg__(self) -> Sum:
        return Sum({key: -value for key, value in self.parts.items()}, self.most, self.bent)

    def __pos__(self) -> Sum:
        return self

    def __sub__(self, other: object) -> Sum:
        return self + -self._of(other)

    def __rsub__(self, other: object) -> Sum:
        return self._of(other) + -self

    def __mul__(self, other: object) -> Sum:
        more, parts = self._of(other), Level()
        bent = self.bent or more.bent
        for one, value in self.parts.items():
            for two, factor in more.parts.items():
                if len(one) + len(two) > self.most:
                    bent = True
                    continue
                key, made = tuple(sorted(one + two)), value * factor
                parts[key] = parts[key] + made if key in parts else made
        return Sum(parts, self.most, bent)

    def __truediv__(self, other: object) -> Sum:
        under = self._of(other)
        if not under.is_free:
            return self * under._inverse()
        return Sum({key: value / under.parts[FREE] for key, value in self.parts.items()}, self.most, self.bent)

    def __rtruediv__(self, other: object) -> Sum:
        return self._of(other) / self

    def __pow__(self, other: object) -> Sum:
        exponent = self._of(other)
        if self.is_free and exponent.is_free:
            return Sum({FREE: self.parts[FREE] ** exponent.parts[FREE]}, self.most)
        power = exponent.parts[FREE]
        if exponent.is_free and isinstance(power, int | float) and power == int(power) and abs(power) <= LARGEST_POWER:
            found = Sum({FREE: 1.0}, self.most)
            for _ in range(abs(int(power))):
                found = found * self
            return found if power >= 0 else found._inverse()
        return (exponent * self.log()).exp()

    def __rpow__(self, other: object) -> Sum:
        return self._of(other) ** self

    __radd__, __rmul__ = __add__, __mul__

    @property
    def levels(self) -> list[Level]:
        """The parts by how many factors they have, ``most + 1`` of them."""
        found: list[Level] = [{} for _ in range(self.most + 1)]
        for key, value in self.parts.items():
            found[len(key)][key] = value
        return found

    def _through(self, function: Callable[[Any], Any]) -> Sum:
        return Sum({FREE: function(self.parts[FREE])}, self.most)

    def _inverse(self) -> Sum:
        """``g`` with ``f g = 1``."""
        f, first = self.levels, 1.0 / self.parts[FREE]
        g = [{FREE: first}]
        for n in range(1, self.most + 1):
            g.append(_mixed([(-1.0, f[k], g[n - k]) for k in range(1, n + 1)], first))
        return _joined(g)

    def exp(self) -> Sum:
        if self.is_free:
            return self._through(np.exp)
        f, g = self.levels, [{FREE: np.exp(self.parts[FREE])}]
        for n in range(1, self.most + 1):
            g.append(_mixed([(k / n, f[k], g[n - k]) for k in range(1, n + 1)]))
        return _joined(g)

    def log(self) -> Sum:
        if self.is_free:
            return self._through(np.log)
        slopes = (_slope(self) * self._inverse()).levels
        return _joined(
            [{FREE: np.log(self.parts[FREE])}, *(_mixed([(1.0 / n, slopes[n], ONE)]) for n in range(1, self.most + 1))]
        )

    def sqrt(self) -> Sum:
        """``g`` with ``g g = f``."""
        if self.is_free:
            return self._through(np.sqrt)
        f, first = self.levels, np.sqrt(self.parts[FREE])
        g, half = [{FREE: first}], 0.5 / first
        for n in range(1, self.most + 1):
            within = [(-1.0, g[k], g[n - k]) for k in range(1, n)]
            g.append(_mixed([(1.0, f[n], ONE), *within], half))
        return _joined(g)

    def sin(self) -> Sum:
        return self._through(np.sin) if self.is_free else _circular(self.levels)[0]

    def cos(self) -> Sum:
        return self._through(np.cos) if self.is_free else _circular(self.levels)[1]

    def tan(self) -> Sum:
        return self._through(np.tan) if self.is_free else _steep(self.levels, np.tan, 1.0)

    def tanh(self) -> Sum:
        return self._through(np.tanh) if self.is_free else _steep(self.levels, np.tanh, -1.0)

    def kepler(self, eccentricity: float) -> Sum:
        """``E`` with ``D E = D M + e cos E D E``."""
        from sparserob_core.control.problem.expression import kepler

        first = kepler(self.parts[FREE], eccentricity)
        if self.is_free:
            return Sum({FREE: first}, self.most)
        M, E, s, c = self.levels, [{FREE: first}], [{FREE: np.sin(first)}], [{FREE: np.cos(first)}]
        steep = 1.0 / (1.0 - c[0][FREE] * eccentricity)
        for n in range(1, self.most + 1):
            within = [(eccentricity * k / n, E[k], c[n - k]) for k in range(1, n)]
            E.append(_mixed([(1.0, M[n], ONE), *within], steep))
            _turn(E, s, c)
        return _joined(E)


def _joined(levels: list[Level]) -> Sum:
    return Sum({key: value for level in levels for key, value in level.items()}, len(levels) - 1, True)


def _slope(f: Sum) -> Sum:
    """``D f``."""
    return Sum({key: value * float(len(key)) for key, value in f.parts.items() if key}, f.most, f.bent)


def _circular(f: list[Level]) -> tuple[Sum, Sum]:
    """The sine and the cosine."""
    s, c = [{FREE: np.sin(f[0][FREE])}], [{FREE: np.cos(f[0][FREE])}]
    while len(s) < len(f):
        _turn(f, s, c)
    return _joined(s), _joined(c)


def _turn(f: list[Level], s: list[Level], c: list[Level]) -> None:
    """Add one level more to the sine and the cosine."""
    n = len(s)
    ahead = _mixed([(k / n, f[k], c[n - k]) for k in range(1, n + 1)])
    c.append(_mixed([(-k / n, f[k], s[n - k]) for k in range(1, n + 1)]))
    s.append(ahead)


def _steep(f: list[Level], function: Callable[[Any], Any], sign: float) -> Sum:
    """``g`` with ``D g = h D f`` and ``h = 1 + sign g g``, so that ``D h = 2 sign g h D f``: of sums of balls with
    fewer that cancel."""
    first = function(f[0][FREE])
    g, h = [{FREE: first}], [{FREE: 1.0 + sign * (first * first)}]
    both = [{FREE: first * h[0][FREE]}]
    for n in range(1, len(f)):
        g.append(_mixed([(k / n, f[k], h[n - k]) for k in range(1, n + 1)]))
        h.append(_mixed([(2.0 * sign * k / n, f[k], both[n - k]) for k in range(1, n + 1)]))
        both.append(_mixed([(1.0, g[k], h[n - k]) for k in range(n + 1)]))
    return _joined(g)


ONE: Level = {FREE: 1.0}


def _mixed(terms: list[tuple[float, Level, Level]], factor: Any = 1.0) -> Level:
    """A sum of products of parts, each times a number, and all of it times a ``factor``."""
    found = Level()
    for number, left, right in terms:
        for one, value in left.items():
            for two, other in right.items():
                key, made = tuple(sorted(one + two)), value * other * number
                found[key] = found[key] + made if key in found else made
    return {key: value * factor for key, value in found.items()}


@final
@dataclass(frozen=True, eq=False)
class ParameterExpansion:
    """The system of a problem about the ``middle (nu,)`` of its parameters."""

    system: VaryingSystem
    middle: tuple[float, ...]

    @cached_property
    def scales(self) -> list[float]:
        """The most that every parameter deviates by, or a double above it."""
        box = self.system.parameters
        if not isinstance(box, Box):
            raise Unchecked("the checker knows boxes of parameters beside the time")
        every = zip(box.lower.tolist(), box.upper.tolist(), self.middle, strict=True)
        return [
            _above(max(Fraction(high) - Fraction(middle), Fraction(middle) - Fraction(low)))
            for low, high, middle in every
        ]

    def coefficients(
        self, entry: object, time: object, most: int = MOST_FACTORS, middle: Sequence[Any] | None = None
    ) -> tuple[dict[tuple[int, ...], np.ndarray], np.ndarray]:
        """A matrix at a time as a power series in the shares up to so many factors, by their numbers, the constant one
        first, about the `middle` or any other number; and of which entries it is not all."""
        nothing: Any = 0.0 * time  # type: ignore[operator]  # a number of the kind of the time
        p = np.empty(1 + len(self.middle), dtype=object)
        p[0] = Sum({FREE: time}, most)
        for j, (value, scale) in enumerate(zip(middle or self.middle, self.scales, strict=True)):
            p[1 + j] = Sum({FREE: nothing + value, **({(j,): nothing + scale} if scale else {})}, most)
        with np.errstate(all="ignore"):
            whole = np.asarray(entry(p) if callable(entry) else entry, dtype=object)
        found, bent = {FREE: np.zeros(whole.shape, dtype=object)}, np.zeros(whole.shape, dtype=bool)
        for place, value in np.ndenumerate(whole):
            one = value if isinstance(value, Sum) else Sum({FREE: value}, most)
            bent[place] = one.bent
            for key, part in one.parts.items():
                found.setdefault(key, np.zeros(whole.shape, dtype=object))[place] = part
        return found, bent

    def tables(self, entry: object, time: object) -> list[np.ndarray]:
        """``f_0, f_1, ..., f_nu`` of a matrix at a time; raises `Unchecked` where it is no such sum."""
        parts, bent = self.coefficients(entry, time)
        if bent.any() or any(len(key) > 1 and any(map(_may_be, table.ravel())) for key, table in parts.items()):
            raise Unchecked("the checker knows parameters beside the time that the state depends on affinely")
        none = np.zeros(parts[FREE].shape, dtype=object)
        return [parts[FREE], *(parts.get((j,), none) for j in range(len(self.middle)))]

    @cached_property
    def is_affine(self) -> bool:
        """Whether the state is an affine function of the parameters."""
        try:
            _ = self.moved
        except Unchecked:
            return False
        return True

    @cached_property
    def moved(self) -> list[list[int]]:
        """The coordinates of every ``y_j``; raises `Unchecked` where the state is not affine in the parameters."""
        d, nu = self.system.states, len(self.middle)
        steady, own, driven = np.zeros((d, d), dtype=bool), np.zeros((nu, d, d), dtype=bool), np.zeros((nu, d), bool)
        for _, _, law in self.system.laws:
            for name in NAMES:
                entry = law.entry(name)
                if entry is None:
                    continue
                first, *others = (
                    [[_may_be(v) for v in row] for row in part] for part in self.tables(entry, Something())
                )
                if name == "A":
                    steady |= np.array(first)
                    own |= np.array(others)
                driven |= np.array(others).any(axis=2)
        onward = np.minimum(np.eye(d) + steady, 1.0)
        for _ in range(d.bit_length()):  # where a state may go in 1, 2, 4, ... steps
            onward = np.minimum(onward @ onward, 1.0)
        found = [np.flatnonzero(onward @ start > 0.0).tolist() for start in driven.astype(float)]
        if any(own[:, :, places].any() for places in found):
            raise Unchecked("the checker knows parameters beside the time that the state depends on affinely")
        return found

    @property
    def size(self) -> int:
        """All coordinates."""
        return self.system.states + sum(map(len, self.moved))

    def seen(self, shares: tuple[float, ...]) -> Array:
        """``x`` as rows on all coordinates, ``(d, size)``, at deviations of the parameters."""
        d = self.system.states
        found, column = np.zeros((d, self.size)), d
        found[:, :d] = np.eye(d)
        for share, places in zip(shares, self.moved, strict=True):
            for place in places:
                found[place, column] = share
                column += 1
        return found

    def corners(self) -> Iterator[tuple[float, ...]]:
        """Those of a box that holds all shares; of parameters that move nothing one suffices."""
        pairs = zip(self.scales, self.moved, strict=True)
        return product(*((-1.0, 1.0) if scale and places else (0.0,) for scale, places in pairs))


@final
@dataclass(frozen=True, eq=False)
class Larger:
    """One of the matrices of the system of all coordinates."""

    parts: ParameterExpansion
    name: str
    entry: object

    def __call__(self, p: Any) -> np.ndarray:
        """The matrix at a time ``(1,)``."""
        whole, moved, d = self.parts.tables(self.entry, p[0]), self.parts.moved, self.parts.system.states
        if self.name != "A":
            return np.concatenate([whole[0], *(one[places] for one, places in zip(whole[1:], moved, strict=True))])
        found, row = np.zeros((self.parts.size, self.parts.size), dtype=object), d
        found[:d, :d] = whole[0]
        for one, places in zip(whole[1:], moved, strict=True):
            rows = slice(row, row + len(places))
            found[rows, :d], found[rows, rows] = one[places], whole[0][np.ix_(places, places)]
            row += len(places)
        return found


def parted(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The problem with coordinates for its parameters beside the time; it itself where there are none that the state is
    an affine function of."""
    system = problem.system
    if not isinstance(system, VaryingSystem) or system.parameters is None:
        return problem
    parts = ParameterExpansion(system, tuple(system.parameters.interior_point().tolist()))
    if not parts.is_affine:  # then it is expanded, box by box by the flow
        return problem
    d, more = system.states, parts.size - system.states
    corners = [parts.seen(shares) for shares in parts.corners()]
    reached = {place for places in parts.moved for place in places}
    if any(reached & set(end.fixed.tolist()) for end in problem.terminal_equalities):
        raise Unchecked("the checker knows fixed final values of states that no parameter beside the time moves")
    several = sum(not isinstance(entry, Return) for entry in problem.windows) > 1
    called_as = [entry.name or (f"path[{i}]" if several else "path") for i, entry in enumerate(problem.windows)]
    called = list(problem.names.states or [f"x{i + 1}" for i in range(d)])
    units = list(problem.names.state_units)
    for name, scale, places in zip(system.names, parts.scales, parts.moved, strict=True):
        called += [f"{called[i]} per {scale:.3g} {name}" for i in places]
        units += [units[i] for i in places] if problem.names.state_units else []
    laws = [(begin, _law(parts, law, begin, until)) for begin, until, law in system.laws]
    return replace(
        problem,
        **with_zeros(problem, more),
        system=VaryingSystem(laws[0][1], system.horizon, system.delay, tuple(laws[1:])),
        path=[one for entry, name in zip(problem.path, called_as, strict=True) for one in _seen(entry, name, corners)],
        terminal=[
            one
            for end in problem.terminal
            for one in (
                [Equality(np.pad(end.values, (0, more), constant_values=np.nan))]
                if isinstance(end, Equality)
                else _bounds(end, corners)
            )
        ],
        integral=[_sums(entry, corners) for entry in problem.integral],
        names=replace(problem.names, states=called, state_units=units),
    )


def _may_be(value: object) -> bool:
    return isinstance(value, Something) or float(value) != 0.0  # type: ignore[arg-type]  # a number then


def _above(exact: Fraction) -> float:
    """The number itself, or the next double above it."""
    found = float(exact)
    return nextafter(found, inf) if Fraction(found) < exact else found


def _law(parts: ParameterExpansion, law: LinearSystem, begin: float, until: float) -> LinearSystem:
    made = {name: Larger(parts, name, law.entry(name)) for name in NAMES if law.entry(name) is not None}
    return LinearSystem(made["A"], made["B"], made["E"], Box([begin], [until]), ("t",), made.get("c"))


def _rows(blocks: list[Array]) -> Array:
    """All rows, every one once, in the order in which they come first."""
    return np.array(list(dict.fromkeys(tuple(row) for block in blocks for row in block.tolist())))


def _bounds(bound: ConvexSet, corners: list[Array]) -> list[ConvexSet]:
    """What a set says at all corners: one with flat sides in rows, another one in a set for every corner."""
    flat = bound.halfspaces()
    if flat is not None:
        every = _rows([np.column_stack([flat[0] @ seen, flat[1]]) for seen in corners])
        return [Polytope(every[:, :-1], every[:, -1])]
    base = bound.base if isinstance(bound, Cylinder) else bound
    b = base.dimension
    leaning = list(dict.fromkeys(tuple(map(tuple, seen[:b, b:].tolist())) for seen in corners))
    return [Cylinder(base, corners[0].shape[1], np.array(one)) for one in leaning]


def _seen(
    entry: PathConstraint | MixedConstraint | ConvexSet, name: str, corners: list[Array]
) -> list[PathConstraint | MixedConstraint]:
    assert not isinstance(entry, ConvexSet)
    d, size = corners[0].shape
    if isinstance(entry, MixedConstraint):
        H, G = np.asarray(entry.H), np.asarray(entry.G)
        every = _rows(
            [np.column_stack([H @ seen, G, np.broadcast_to(np.asarray(entry.h), len(H))]) for seen in corners]
        )
        return [replace(entry, name=name, H=every[:, :size], G=every[:, size:-1], h=every[:, -1])]
    rows = None if entry.relative_to is None else np.asarray(entry.relative_to)
    moved = None if rows is None else np.pad(rows, ((0, 0), (0, size - d)))
    found = _bounds(entry.set, corners)
    return [
        replace(entry, name=name if len(found) == 1 else f"{name} at corner {k + 1}", set=one, relative_to=moved)
        for k, one in enumerate(found)
    ]


def _sums(entry: IntegralConstraint, corners: list[Array]) -> IntegralConstraint:
    size, sides = corners[0].shape[1], [np.asarray(one, dtype=float) for one in (entry.lower, entry.upper)]
    every = _rows([np.column_stack([np.asarray(entry.H) @ seen, np.asarray(entry.G), *sides]) for seen in corners])
    return replace(entry, H=every[:, :size], G=every[:, size:-2], lower=every[:, -2], upper=every[:, -1])
