"""The cost of a control: an integral of absolute values or norms, and quadratic terms of the nominal trajectory.

The weights of the integral are constant or piecewise constant in time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Literal, TypeAlias, final

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.control.term import TERMS, UNITLESS, Term, measured, timed
from sparserob_core.errors import InputError
from sparserob_core.shapes import dense
from sparserob_core.sip.convex_set import Array, ConvexSet, as_bound
from sparserob_core.sip.convexity import ENTRY_ROUNDING, is_definite, require_convex

EXACT = 16  # rows up to which a matrix is shown to be positive semidefinite in fractions


@final
@dataclass(frozen=True, eq=False)
class Quadratic(Term):
    """A quadratic term ``(v - reference)' Q (v - reference)`` of a vector ``v (d,)``.

    Parameters
    ----------
    Q : array (d, d)
        A symmetric, positive semidefinite matrix.
    reference : array (d,)
        The vector with which ``v`` is compared, in the units of ``v``.
    """

    Q: Array = field(metadata=measured(lambda of: of.cost / np.outer(of.states, of.states)))
    reference: Array = field(metadata=measured(lambda of: of.states))

    __repr__ = noun


Weighted: TypeAlias = Quadratic | Mapping[str, npt.ArrayLike]
OF_STATES = measured(lambda of: replace(of, cost=of.cost / of.time))
OF_CONTROLS = measured(lambda of: replace(of, states=of.controls, cost=of.cost / of.time))


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class Cost(Term):
    """The cost ``J = l1 int sum_i weights_i |u_i| dt + int (x - r)' Q (x - r) dt + int u' R u dt + (x(T) - r)' Q (x(T)
    - r)``.

    Here ``x (d,)`` is the nominal trajectory, that of the `nominal_point` of every uncertainty set, and ``u (m,)`` is
    the control. The ``weights`` are those of the `OptimalControlProblem`. All matrices are symmetric and positive
    semidefinite.

    Parameters
    ----------
    l1 : float, default 1.0
        The factor of the first integral, without unit; 0 for a purely quadratic cost.
    group : list of lists of int, or "all", optional
        Groups of channels, counted from 1, as in ``[[1, 2], [3]]``; ``all`` is one group. The Euclidean norm of a group
        replaces the sum of its absolute values. A channel in no group counts by its absolute value. No groups unless
        given.
    state : mapping {"Q": (d, d), "reference": (d,)}, optional
        The matrix and the reference of the integral over the state; the reference is 0 unless given. ``Q`` makes the
        integrand a cost per time. No such term unless given.
    control : mapping {"R": (m, m)}, optional
        The matrix of the integral over the control. ``R`` makes the integrand a cost per time. No such term unless
        given.
    final : mapping {"Q": (d, d), "reference": (d,)}, optional
        The matrix and the reference of the term of the final state, which is a cost. No such term unless given.

    Notes
    -----
    The fields are checked when a problem is made with the cost (`checked`).

    Examples
    --------
    >>> import sparserob_core as sr
    >>> sr.Cost(l1=0.5, group="all", control={"R": [[0.1, 0], [0, 0.1]]}).l1
    0.5
    """

    l1: float = field(default=1.0, metadata=UNITLESS)
    group: Sequence[Sequence[int]] | Literal["all"] | None = field(default=None, metadata=UNITLESS)
    state: Weighted | None = field(default=None, metadata=OF_STATES)
    control: Weighted | None = field(default=None, metadata=OF_CONTROLS)
    final: Weighted | None = field(default=None, metadata=TERMS)

    __repr__ = noun

    def checked(self, states: int, controls: int, weights: Array) -> Cost:
        """Return the cost with `Quadratic` terms and with tuples for groups, after a check of all fields.

        Parameters
        ----------
        states, controls : int
            The numbers ``d`` of states and ``m`` of controls.
        weights : array (m,) or (r, 1 + m)
            The weights of the problem, which must be equal within a group.

        Returns
        -------
        Cost
            The checked cost.

        Raises
        ------
        InputError
            If a field is unsuitable, or nothing is left to be minimised; the error begins with the key below ``cost``.
        """
        try:
            l1 = float(self.l1)
        except (TypeError, ValueError):
            l1 = np.nan
        if not 0.0 <= l1 < np.inf or isinstance(self.l1, bool):
            raise InputError(path="l1", expected="a number, at least 0", got=f"{self.l1!r}")
        group = _check_groups(self.group, controls, weights)
        if group and l1 == 0.0:
            raise InputError("nothing is left to group where l1 is 0", path="group")
        state, final = (
            _check_term(key, term, "Q", states) for key, term in (("state", self.state), ("final", self.final))
        )
        control = _check_term("control", self.control, "R", controls)
        if l1 == 0.0 and not any(term is not None and term.Q.any() for term in (state, control, final)):
            raise InputError(path="l1", expected="a number above 0, or one of state, control and final", got="0")
        return replace(self, l1=l1, group=group, state=state, control=control, final=final)

    @property
    def blocks(self) -> tuple[tuple[int, ...], ...]:
        """The groups with at least two channels, counted from 0, of a `checked` cost."""
        assert self.group != "all"
        return tuple(tuple(int(c) - 1 for c in group) for group in self.group or () if len(group) > 1)

    @property
    def terms(self) -> tuple[Quadratic | None, Quadratic | None, Quadratic | None]:
        """The quadratic terms of state, control and final state, of a `checked` cost; ``None`` where one is absent."""
        terms = (self.state, self.control, self.final)
        assert all(term is None or isinstance(term, Quadratic) for term in terms)
        return terms  # type: ignore[return-value]

    @property
    def is_quadratic(self) -> bool:
        """True where there is a quadratic term."""
        return any(term is not None for term in self.terms)

    @property
    def is_linear(self) -> bool:
        """True where the cost is a weighted sum of absolute values, without groups and quadratic terms."""
        return not self.is_quadratic and not self.blocks

    def words(self) -> str:
        """Return the parts of the cost in a few words, or an empty text where the cost is the L1 norm alone."""
        if self.is_linear and self.l1 == 1.0:
            return ""
        state, control, final = self.terms
        norms = []
        if self.l1 > 0.0:
            factor = "" if self.l1 == 1.0 else f"{self.l1:g} "
            norms.append(f"{factor}{'norm of groups' if self.blocks else 'L1 norm'}")
        names = (("quadratic state", state), ("quadratic control", control), ("quadratic final state", final))
        return " + ".join(norms + [name for name, term in names if term is not None])


def nominal_point(convex: ConvexSet) -> Array:
    """Return the centre ``(d,)`` of an uncertainty set, to which the nominal trajectory belongs.

    The centre is the middle of the bounding box where the set contains it. Elsewhere it is the mean of the vertices, or
    an interior point of a set without known vertices.
    """
    box = convex.bounding_box()
    middle = (box.lower + box.upper) / 2
    if bool(convex.contains(middle)):
        return np.asarray(middle, dtype=float)
    vertices = getattr(convex, "vertices", None)
    return convex.interior_point() if vertices is None else np.asarray(vertices, dtype=float).mean(axis=0)


def _check_groups(given: object, controls: int, weights: Array) -> tuple[tuple[int, ...], ...] | None:
    """Return the groups of channels, counted from 1, as tuples; raise `InputError` where they are unsuitable."""
    if given is None:
        return None
    if isinstance(given, str):
        if given != "all":
            raise InputError(path="group", expected="lists of channels, as [[1, 2], [3]], or all", got=f"{given!r}")
        given = [range(1, controls + 1)]
    try:
        groups = tuple(tuple(group) for group in given)  # type: ignore[attr-defined]
    except TypeError:
        raise InputError(
            path="group", expected="lists of channels, as [[1, 2], [3]], or all", got=f"{given!r}"
        ) from None
    channels = [channel for group in groups for channel in group]
    for channel in channels:
        is_integer = isinstance(channel, int | np.integer) and not isinstance(channel, bool)
        if not is_integer or not 1 <= channel <= controls:
            raise InputError(path="group", expected=f"channels from 1 to {controls}", got=f"{channel!r}")
    if len(set(channels)) < len(channels) or not all(groups):
        raise InputError(
            path="group",
            expected="every channel in one group at most, and no group empty",
            got=f"{[list(map(int, group)) for group in groups]}",
        )
    integer_groups = tuple(tuple(int(channel) for channel in group) for group in groups)
    for group in integer_groups:
        entries = by_time(weights)[1].T[np.array(group) - 1]
        if (entries != entries[0]).any():
            raise InputError(
                path="group",
                expected="equal weights within a group",
                got=f"{np.squeeze(entries, axis=-1 if entries.shape[1] == 1 else ()).tolist()} for {list(group)}",
            )
    return integer_groups


def _check_term(key: str, given: object, letter: str, size: int) -> Quadratic | None:
    """Return one quadratic term from a mapping ``{letter: matrix, reference: vector}``, or ``None`` where it is absent.

    Parameters
    ----------
    key : str
        The key of the term: ``state``, ``control`` or ``final``.
    given : object
        The mapping, a `Quadratic`, or ``None``.
    letter : str
        The key of the matrix in the mapping.
    size : int
        The number of rows of the matrix.

    Raises
    ------
    InputError
        If the mapping has other keys, if a shape is wrong, or if the matrix is not positive semidefinite.
    """
    if given is None:
        return None
    reference: object
    if isinstance(given, Quadratic):
        matrix, reference = given.Q, given.reference
    elif isinstance(given, Mapping):
        keys = {letter} if key == "control" else {letter, "reference"}
        if letter not in given or not set(given) <= keys:
            raise InputError(path=key, expected=f"{{{', '.join(sorted(keys))}}}", got=f"{sorted(map(str, given))}")
        matrix, reference = given[letter], given.get("reference")
    else:
        raise InputError(path=key, expected=f"a mapping with {letter}", got=f"{type(given).__name__}")
    quantity = "control" if key == "control" else "state"
    Q = _check_numbers(
        f"{key}.{letter}", matrix, (size, size), f"a {size} by {size} matrix of finite numbers, a row per {quantity}"
    )
    r = np.zeros(size)
    if reference is not None:
        r = _check_numbers(f"{key}.reference", reference, (size,), f"{size} finite numbers, one per {quantity}")
    return Quadratic(_require_semidefinite(f"{key}.{letter}", Q), r)


def _check_numbers(path: str, given: object, shape: tuple[int, ...], expected: str) -> Array:
    """Return an array of finite numbers of the given shape; raise `InputError`."""
    try:
        array = np.asarray(dense(given), dtype=float)
    except (TypeError, ValueError):
        raise InputError(path=path, expected=expected, got=f"{given!r}") from None
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(path=path, expected=expected, got=f"{array.tolist()}")
    return array + 0.0


def _require_semidefinite(path: str, Q: Array) -> Array:
    """Return a symmetric positive semidefinite matrix; raise `InputError` for other matrices.

    A matrix that is semidefinite up to rounding is made so by a small addition to its diagonal, because the checker
    shows the property in fractions.
    """
    form = require_convex(path, Q, Q.shape[0])
    Q, diagonal = form.toarray(), form.diagonal()
    small, kept = ENTRY_ROUNDING * Q.shape[0], np.flatnonzero(diagonal > 0.0)
    if form.nnz == np.count_nonzero(diagonal) or (Q.shape[0] <= EXACT and _is_exactly_semidefinite(Q)):
        return Q
    if is_definite(form[kept][:, kept], 1.0 - 2.0 * small):
        return Q
    return Q + np.diag(4.0 * small * diagonal)


def _is_exactly_semidefinite(Q: Array) -> bool:
    """Return True where symmetric elimination in fractions shows that a matrix is positive semidefinite.

    No pivot may be negative, and the rest of the row of a pivot that is 0 must be 0 too.
    """
    rows = [[Fraction(float(entry)) for entry in row] for row in Q]
    for k in range(len(rows)):
        pivot = rows[k][k]
        if pivot < 0 or (pivot == 0 and any(rows[k][k + 1 :])):
            return False
        for i in range(k + 1, len(rows)):
            if pivot and rows[i][k]:
                factor = rows[i][k] / pivot
                rows[i] = [entry - factor * pivot_entry for entry, pivot_entry in zip(rows[i], rows[k], strict=True)]
    return True


def checked_weights(given: npt.ArrayLike | None, controls: int, horizon: float) -> Array:
    """Return the weights of the controls as an array, after a check.

    Parameters
    ----------
    given : array-like or None
        A number for all controls, one number per control, or rows of a time and the weights from then on. ``None`` is
        1.
    controls : int
        The number ``m`` of controls.
    horizon : float
        The horizon, before which the last row must begin.

    Returns
    -------
    array (m,) or (r, 1 + m)
        Positive weights, or rows of a time and weights that are not negative. A single row of positive weights is
        returned as ``(m,)``. The times begin at 0 and increase.

    Raises
    ------
    InputError
        If the numbers are not of this form.
    """
    given = 1.0 if given is None else given
    if isinstance(given, str | bytes) or not _is_nested(given):
        weights = as_bound("weights", given, controls)
        if not ((weights > 0.0) & np.isfinite(weights)).all():
            raise InputError(
                path="weights", expected=f"{controls} positive numbers, one per control", got=f"{weights.tolist()}"
            )
        return weights
    rows = _check_rows(given, controls, horizon)
    return rows[0, 1:] if len(rows) == 1 and (rows[0, 1:] > 0.0).all() else rows


def _is_nested(given: npt.ArrayLike) -> bool:
    """Return True where weights are given as rows."""
    if isinstance(given, np.ndarray):
        return given.ndim > 1
    return isinstance(given, list | tuple) and any(isinstance(row, list | tuple | np.ndarray) for row in given)


def _check_rows(given: npt.ArrayLike, controls: int, horizon: float) -> Array:
    """Return rows ``(r, 1 + m)`` of a time and the weights from then on; raise `InputError`."""
    expected = f"rows of {1 + controls} numbers, a time and a weight for every control"
    try:
        rows = np.array(given, dtype=float)
    except (TypeError, ValueError):
        raise InputError(path="weights", expected=expected, got=f"{given!r}") from None
    if rows.ndim != 2 or rows.shape[1] != 1 + controls or not np.isfinite(rows).all():
        raise InputError(path="weights", expected=expected, got=f"{rows.tolist()}")
    times, weights = rows[:, 0], rows[:, 1:]
    if times[0] != 0.0 or (np.diff(times) <= 0.0).any() or times[-1] >= horizon:
        raise InputError(
            path="weights",
            expected=f"times that begin at 0, increase, and end before {horizon:g} (the horizon)",
            got=f"{times.tolist()}",
        )
    if (weights < 0.0).any():
        raise InputError(path="weights", expected="weights that are not negative", got=f"{weights.tolist()}")
    return np.asarray(rows + 0.0)


def by_time(weights: object) -> tuple[Array, Array]:
    """Return the times ``(r,)`` from which weights hold, the first of them 0, and the weights ``(r, m)``.

    The argument is the result of `checked_weights`.
    """
    rows = np.asarray(weights, dtype=float)
    return (np.zeros(1), rows[None]) if rows.ndim == 1 else (rows[:, 0], rows[:, 1:])


def integrals(weights: object, breakpoints: Array) -> Array:
    """Return the integrals of the weights over intervals of time.

    Weights may change within an interval. The integrals are exact except for the rounding of the sums.

    Parameters
    ----------
    weights : array (m,) or (r, 1 + m)
        The result of `checked_weights`.
    breakpoints : array (K + 1,)
        The times between which the intervals lie.

    Returns
    -------
    array (m, K)
        The integral of each weight over each interval.
    """
    times, values = by_time(weights)
    begins, ends = breakpoints[:-1], breakpoints[1:]
    if times.size == 1:
        return np.outer(values[0], ends - begins)
    overlap = np.minimum(ends, np.append(times[1:], np.inf)[:, None]) - np.maximum(begins, times[:, None])
    return np.asarray(values.T @ np.maximum(overlap, 0.0))


def counted(weights: object) -> Array:
    """Return the number ``(m,)`` by which each control counts per time that it is active.

    The number is the weight of the control. It is 1 where weights change with time, since activity measures time and
    not cost.
    """
    rows = np.asarray(weights, dtype=float)
    return rows if rows.ndim == 1 else np.ones(rows.shape[1] - 1)


def weights_between(weights: object, begin: float, horizon: float) -> Array:
    """Return the weights that remain from one time on, with times counted from there.

    Parameters
    ----------
    weights : array (m,) or (r, 1 + m)
        The result of `checked_weights`.
    begin : float
        The time from which the weights remain.
    horizon : float
        The duration for which they are needed.

    Returns
    -------
    array (m,) or (q, 1 + m)
        The weights, or rows of a time and the weights from then on.
    """
    rows = np.asarray(weights, dtype=float)
    if rows.ndim == 1:
        return rows
    kept = rows[int(np.searchsorted(rows[:, 0], begin, side="right")) - 1 :].copy()
    kept[:, 0] = np.maximum(kept[:, 0] - begin, 0.0)
    return kept[kept[:, 0] < horizon]


WEIGHTS = timed(lambda of: of.cost / (of.controls * of.time), weights_between)
