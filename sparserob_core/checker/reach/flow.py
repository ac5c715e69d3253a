"""The response of an uncertain linear system over one box of parameters, as polynomials in the parameters with balls as
coefficients.

Power series of ball matrices solve for the coefficients; Lagrange's remainder is bounded by a comparison system for the
norms of the first coefficients left out, with the logarithmic norm in modal coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import sqrt
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.jets import Monomials, expanded
from sparserob_core.checker.arithmetic.series import Exponentials, Series, norm, upper
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat

    from sparserob_core.control.problem.system import LinearSystem, System

WELL_CONDITIONED = 1e6
SWEEPS = 12  # of balancing
FAINT = 1e-6  # with 1 a state's own source would be overlooked beside others, with 0 its unit may be that of a speck
LEAST = 2.0**-900  # rate that takes part in it; units end at 2^-500
ORDER = 6  # of the expansion in time


@final
@dataclass(frozen=True, eq=False)
class Flow:
    """The system over the box ``centre +- radius`` (``(nu,)`` exact numbers), expanded to ``degree`` in the parameters.

    A *row* is the functional ``c'e^{A s}``, as a column, and below it its integral times ``E``.
    """

    system: LinearSystem
    centre: tuple[float, ...]
    radius: tuple[float, ...]
    degree: int

    @cached_property
    def monomials(self) -> Monomials:
        return Monomials(len(self.centre), self.degree if self.centre else 0)

    @cached_property
    def parts(self) -> dict[str, list[arb_mat]]:
        """Taylor coefficients of ``A``, ``B``, ``E`` at the centre."""
        from flint import arb

        return expanded(self.system, self.monomials, [arb(c) for c in self.centre], self.radius)

    @cached_property
    def sizes(self) -> Array:
        """The norms of the coefficients of ``A``, ``B`` and ``E``, summed, one per monomial."""
        return np.array(
            [sum(float(norm(part).mid()) for part in parts) for parts in zip(*self.parts.values(), strict=True)]
        )

    @cached_property
    def states(self) -> Series:
        """``A``."""
        return Series(self.monomials, self.parts["A"])

    @cached_property
    def inputs(self) -> Series:
        """``B``."""
        return Series(self.monomials, self.parts["B"])

    @cached_property
    def rows(self) -> Series:
        """The matrix of a row and of its integral times ``E``."""
        from flint import arb, arb_mat

        mw = self.parts["E"][0].ncols()
        table = [
            [row + [arb(0)] * mw for row in a.transpose().tolist() + e.transpose().tolist()]
            for a, e in zip(self.parts["A"], self.parts["E"], strict=True)
        ]
        return Series(self.monomials, [arb_mat(part) for part in table])


@final
@dataclass(frozen=True, eq=False)
class Remainder:
    """``n_j``, the summed norms of the coefficients of degree ``j <= D`` of the state, and ``n_{D+1}``, the norm of
    what the polynomial of degree ``D`` differs from the state by, anywhere in the box, obey
    ``n' <= growth n + source |u|``.

    The difference ``e`` starts at 0, and ``e' = A e`` plus what the polynomial leaves of the equation: the products of
    coefficients of ``A`` and of the state whose degrees add up to more than ``D``. So it is small where the last
    coefficients of the state are, whatever bounds of their growth would say.

    ``growth (D+2, D+2)``; ``control (D+2, m)``, ``disturbance``: per degree, the norms of every column of ``B``, and of
    ``E``. ``transform`` ``T``: norms are those of ``T^-1 x``.
    """

    growth: arb_mat
    control: arb_mat
    disturbance: list[list[arb]]
    transform: Array
    inverse: arb_mat

    @staticmethod
    def of(flow: Flow, horizon: float, speed: Array) -> Remainder:
        """Bounds up to the ``horizon``, in units that fit states which their sources move by ``speed (d,)`` per
        time."""
        from flint import arb, arb_mat

        degree = flow.degree + 1
        monomials = Monomials(len(flow.centre), degree)
        wide = [arb(c, abs(r)) for c, r in zip(flow.centre, flow.radius, strict=True)]
        parts = expanded(flow.system, monomials, wide, flow.radius)
        T = _coordinates(middles(flow.parts["A"][0]), horizon, speed)
        exact = arb_mat(T.tolist())
        inverse = exact.inv()

        def per_degree(matrices: Sequence[arb_mat]) -> list[arb]:
            totals = [arb(0)] * (degree + 1)
            for e, matrix in zip(monomials.exponents, matrices, strict=True):
                totals[sum(e)] = totals[sum(e)] + upper(norm(matrix))
            return totals

        A = per_degree([inverse * a * exact for a in parts["A"]])
        A[0] = upper(logarithmic_norm(inverse * parts["A"][0] * exact))
        table = [[A[i - j] if j <= i else arb(0) for j in range(degree + 1)] for i in range(degree)]
        growth = stacked([*table, [*beyond(A), A[0]]])
        driven, columns = (
            [per_degree([inverse * column(e, c) for e in parts[name]]) for c in range(parts[name][0].ncols())]
            for name in ("B", "E")
        )
        return Remainder(growth, stacked(driven).transpose(), columns, T, inverse)

    def start(self, size: arb) -> arb_mat:
        """The norms at the beginning, where nothing depends on the parameters."""
        from flint import arb

        return stacked([[size if j == 0 else arb(0)] for j in range(self.growth.nrows())])

    def closer(self, norms: arb_mat, parts: Sequence[arb_mat], exponents: Sequence[Sequence[int]]) -> arb_mat:
        """Bounds of ``norms``, replaced by the norms of the coefficients ``parts``, in the coordinates ``T``, where
        these are smaller."""
        from flint import arb

        actual = [arb(0)] * (norms.nrows() - 1)
        for e, part in zip(exponents, parts, strict=True):
            actual[sum(e)] = actual[sum(e)] + norm(part)
        kept = [upper(bound).min(upper(size)) for bound, size in zip(norms.entries(), actual, strict=False)]
        return stacked([[size] for size in (*kept, upper(norms[norms.nrows() - 1, 0]))])


def beyond(sizes: Sequence[arb]) -> list[arb]:
    """For every degree ``j`` from 0 to ``D`` the sum of the ``sizes`` of degrees ``D + 1 - j`` to ``D + 1``: what a
    coefficient of degree ``j`` is multiplied by in a product's terms beyond the degree ``D``."""
    from flint import arb

    return [sum(sizes[len(sizes) - 1 - j :], arb(0)) for j in range(len(sizes) - 1)]


def flows(
    system: System, centre: Sequence[float], radius: Sequence[float] | None = None, degree: int = 0
) -> list[Flow]:
    """The systems that take turns, each over one box of parameters; at one parameter without a ``radius``."""
    point = tuple(map(float, centre))
    width = (0.0,) * len(point) if radius is None else tuple(map(float, radius))
    return [Flow(mode, point, width, degree) for mode in system.modes]


def stacked(table: Sequence[Sequence[arb]]) -> arb_mat:
    """A ball matrix from its rows."""
    from flint import arb_mat

    return arb_mat([list(row) for row in table])


def scaled(matrix: arb_mat, rows: Array, columns: Array) -> arb_mat:
    """A ball matrix with its rows and its columns multiplied by powers of two, which is exact."""
    factors = list(map(float, columns))
    return stacked(
        [
            [x * row * factor for x, factor in zip(line, factors, strict=True)]
            for line, row in zip(matrix.tolist(), map(float, rows), strict=True)
        ]
    )


def column(matrix: arb_mat, number: int) -> arb_mat:
    """One column of a ball matrix."""
    return stacked([[matrix[i, number]] for i in range(matrix.nrows())])


def logarithmic_norm(matrix: arb_mat) -> arb:
    """An upper bound of the largest eigenvalue of the symmetric part (Gershgorin): ``|e^{A t}| <= e^{mu t}`` (Dahlquist
    1958)."""
    d = matrix.nrows()
    discs = [
        matrix[i, i] + sum((abs(matrix[i, j] + matrix[j, i]) / 2 for j in range(d) if j != i), start=matrix[i, i] * 0)
        for i in range(d)
    ]
    largest = discs[0]
    for disc in discs[1:]:
        largest = largest.max(disc)
    return largest


def up_to(length: arb) -> arb:
    """The ball of all numbers from 0 to ``length``."""
    from flint import arb

    return arb(0).union(length)


def in_time(matrix: Series, derivative: Series, length: arb, inside: Series) -> list[Series]:
    """The terms of order 1, 2, ... of a solution of ``y' = matrix y`` in the time over ``length``, from its derivative
    at the start.

    The last term is Lagrange's: with ``inside``, which holds ``e^{matrix s}`` for every ``s`` up to ``length``, it is
    right anywhere in between.
    """
    derivatives = [derivative]
    while len(derivatives) < ORDER:
        derivatives.append(matrix * derivatives[-1])
    return expansion(derivatives, length, inside)


def expansion(derivatives: Sequence[Series], length: arb, inside: Series) -> list[Series]:
    """`in_time` from the first derivatives at the start, `ORDER` of them."""
    terms, factor = [], length
    for order, v in enumerate(derivatives, 1):
        terms.append(v.scaled(factor) if order < ORDER else (inside * v).scaled(factor))
        factor = factor * length / (order + 1)
    return terms


def exponentials(matrix: Series, tick: float, horizon: float) -> Exponentials:
    """Those of a matrix in units in which it is small."""
    sizes = np.sum([np.abs(middles(part)) for part in matrix.parts], axis=0)
    units = balanced(sizes, horizon, np.zeros(sizes.shape[0])) if np.isfinite(sizes).all() else None
    return Exponentials(matrix, tick, None if units is None else units.tolist())


def held(matrix: arb_mat, inputs: arb_mat, time: arb) -> tuple[arb_mat, arb_mat]:
    """`Series.held` of matrices that do not depend on the parameters."""
    known = Monomials(0, 0)
    Phi, Gamma = Series(known, [matrix]).held(Series(known, [inputs]), time)
    return Phi.parts[0], Gamma.parts[0]


def middles(matrix: arb_mat) -> Array:
    """The middles of balls."""
    return np.array([[float(x.mid()) for x in row] for row in matrix.tolist()])


def _coordinates(A: Array, horizon: float, speed: Array) -> Array:
    """Any invertible matrix would be right; this one keeps ``e^{mu t}`` small: every state in a unit of its own, and
    real modal coordinates where these are not worse conditioned than they help."""
    units = balanced(A, horizon, speed)
    scaled = A / units[:, None] * units
    best, least = np.eye(A.shape[0]), np.inf
    for T in (best, _modal(scaled)):
        if T.shape != A.shape or not np.isfinite(T).all() or not np.linalg.cond(T) < WELL_CONDITIONED:
            continue
        S = np.linalg.solve(T, scaled @ T)
        S = (S + S.T) / 2
        growth = float((np.diag(S) + np.abs(S - np.diag(np.diag(S))).sum(axis=1)).max())
        loss = max(0.0, growth * horizon) + float(np.log(np.linalg.cond(T)))
        if loss < least:
            best, least = T, loss
    return np.asarray(units[:, None] * best, dtype=float)


def balanced(A: Array, horizon: float, speed: Array) -> Array:
    """Units ``(d,)`` of the states, powers of two, in which rows and columns of ``A`` are about as large as each other
    (Osborne 1960).

    The sources take part as one more state, and where one state drives another but not the reverse, a small number
    stands for the reverse: what makes the two of the size that one reaches through the other within the horizon. A
    source that moves a state by next to nothing of what it is moved by through others does not count.
    """
    rates = np.zeros((speed.size + 1, speed.size + 1))
    rates[:-1, :-1], rates[:-1, -1] = np.abs(A), speed
    np.fill_diagonal(rates, 0.0)
    through = reached = speed
    with np.errstate(over="ignore", invalid="ignore"):
        for turn in range(1, speed.size):
            reached = horizon / turn * (rates[:-1, :-1] @ reached)
            through = through + reached
        rates[:-1, -1] = np.where(speed < FAINT * through, 0.0, speed)
    rates[rates < LEAST] = 0.0  # such are what outward rounding makes of no drive at all; they have no reciprocal
    driven = np.where(rates > 0.0, rates, np.inf)
    rates = np.maximum(rates, (1.0 / horizon / horizon / driven).T)
    exponents = np.zeros(speed.size + 1)
    for _ in range(SWEEPS):
        for i in range(exponents.size):
            scaled = np.exp2(exponents)
            row, column = (rates[i] * scaled).max() / scaled[i], (rates[:, i] / scaled).max() * scaled[i]
            if row > 0.0 and column > 0.0:
                exponents[i] += (np.log2(row) - np.log2(column)) / 2  # apart: their quotient may overflow
    return np.asarray(np.exp2(np.clip(np.round(exponents[:-1] - exponents[-1]), -500, 500)), dtype=float)


@final
@dataclass(frozen=True, eq=False)
class OwnUnits:
    """Units ``(d,)`` of the states, powers of two, in which a system's ``matrix`` is small: what is left of an
    expansion is bounded in these."""

    matrix: arb_mat
    units: Array

    @staticmethod
    def of(A: arb_mat, horizon: float, speed: Array) -> OwnUnits:
        """Those of ``x' = A x`` with sources of about this ``speed (d,)``: any would be right."""
        return OwnUnits(A, balanced(middles(A), horizon, speed))

    @cached_property
    def growth(self) -> arb:
        """The norm of the matrix in these units."""
        return norm(self.rows(self.states(self.matrix)))

    def states(self, columns: arb_mat) -> arb_mat:
        """Columns of states ``(d, n)`` in these units."""
        return scaled(columns, 1.0 / self.units, np.ones(columns.ncols()))

    def rows(self, rows: arb_mat) -> arb_mat:
        """Rows on states ``(r, d)``, on such in these units."""
        return scaled(rows, np.ones(rows.nrows()), self.units)


def _modal(A: Array) -> Array:
    values, vectors = np.linalg.eig(A)
    columns = [
        part
        for i, value in enumerate(values)
        if value.imag >= 0
        for part in ((vectors[:, i].real,) if value.imag == 0 else (vectors[:, i].real, vectors[:, i].imag))
    ]
    return np.stack(columns, axis=1) * sqrt(A.shape[0])
