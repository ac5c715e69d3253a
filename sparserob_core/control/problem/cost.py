"""What a control costs: its integral of absolute values or of norms, with weights that are constant or piecewise
constant in time, and quadratic terms of the nominal trajectory."""

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
from sparserob_core.sip.convexity import ROUNDED, is_definite, require_convex

EXACT = 16  # states up to which a matrix is shown to be positive semidefinite in fractions


@final
@dataclass(frozen=True, eq=False)
class Quadratic(Term):
    """``(v - reference)' Q (v - reference)``: ``Q (d, d)`` symmetric and positive semidefinite, ``reference (d,)``."""

    Q: Array = field(metadata=measured(lambda of: of.cost / np.outer(of.states, of.states)))
    reference: Array = field(metadata=measured(lambda of: of.states))

    __repr__ = noun


Weighted: TypeAlias = Quadratic | Mapping[str, npt.ArrayLike]
OF_STATES = measured(lambda of: replace(of, cost=of.cost / of.time))
OF_CONTROLS = measured(lambda of: replace(of, states=of.controls, cost=of.cost / of.time))


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class Cost(Term):
    """``J = l1 int sum_i weights_i |u_i| dt + int (x - r)' Q (x - r) dt + int u' R u dt + (x(T) - r)' Q (x(T) - r)``,
    ``x`` the nominal trajectory.

    ``l1``: factor of the first integral, 0 for a purely quadratic cost. ``group``: channels, counted from 1, that count
    with their Euclidean norm instead of their absolute values, as ``[[1, 2], [3]]``, or ``all`` for one group; a
    channel in no group counts alone. ``state``, ``final``: ``{Q: (d, d), reference: (d,)}``, the reference 0 unless
    given; ``control``: ``{R: (m, m)}``. All matrices symmetric and positive semidefinite. Units: ``l1`` has none,
    ``Q`` and ``R`` make the integrals cost per time, ``final`` is a cost.

    The nominal trajectory is that of the `nominal_point` of every uncertainty set.
    """

    l1: float = field(default=1.0, metadata=UNITLESS)
    group: Sequence[Sequence[int]] | Literal["all"] | None = field(default=None, metadata=UNITLESS)
    state: Weighted | None = field(default=None, metadata=OF_STATES)
    control: Weighted | None = field(default=None, metadata=OF_CONTROLS)
    final: Weighted | None = field(default=None, metadata=TERMS)

    __repr__ = noun

    def checked(self, states: int, controls: int, weights: Array) -> Cost:
        """The same cost for that many states and controls, with `Quadratic` terms and tuples for groups; raises
        `InputError` that begins with the key below ``cost``."""
        try:
            l1 = float(self.l1)
        except (TypeError, ValueError):
            l1 = np.nan
        if not 0.0 <= l1 < np.inf or isinstance(self.l1, bool):
            raise InputError(path="l1", expected="a number, at least 0", got=f"{self.l1!r}")
        group = _groups(self.group, controls, weights)
        if group and l1 == 0.0:
            raise InputError("nothing is left to group where l1 is 0", path="group")
        state, final = (_term(key, term, "Q", states) for key, term in (("state", self.state), ("final", self.final)))
        control = _term("control", self.control, "R", controls)
        if l1 == 0.0 and not any(term is not None and term.Q.any() for term in (state, control, final)):
            raise InputError(path="l1", expected="a number above 0, or one of state, control and final", got="0")
        return replace(self, l1=l1, group=group, state=state, control=control, final=final)

    @property
    def blocks(self) -> tuple[tuple[int, ...], ...]:
        """The groups of two channels or more, counted from 0."""
        assert self.group != "all"
        return tuple(tuple(int(c) - 1 for c in group) for group in self.group or () if len(group) > 1)

    @property
    def terms(self) -> tuple[Quadratic | None, Quadratic | None, Quadratic | None]:
        """The quadratic terms of state, control and final state, of a `checked` cost."""
        found = (self.state, self.control, self.final)
        assert all(term is None or isinstance(term, Quadratic) for term in found)
        return found  # type: ignore[return-value]

    @property
    def is_quadratic(self) -> bool:
        """Whether there are quadratic terms."""
        return any(term is not None for term in self.terms)

    @property
    def is_linear(self) -> bool:
        """Whether it is a weighted sum of absolute values."""
        return not self.is_quadratic and not self.blocks

    def words(self) -> str:
        """What is added up to the cost, in a few words; empty where that is the L1 norm alone."""
        if self.is_linear and self.l1 == 1.0:
            return ""
        state, control, final = self.terms
        parts = []
        if self.l1 > 0.0:
            factor = "" if self.l1 == 1.0 else f"{self.l1:g} "
            parts.append(f"{factor}{'norm of groups' if self.blocks else 'L1 norm'}")
        names = (("quadratic state", state), ("quadratic control", control), ("quadratic final state", final))
        return " + ".join(parts + [name for name, term in names if term is not None])


def nominal_point(convex: ConvexSet) -> Array:
    """The centre of an uncertainty set ``(d,)``, which the nominal trajectory is that of: the middle of its bounding
    box if that is inside, else the mean of its vertices, or an interior point where there are none."""
    box = convex.bounding_box()
    middle = (box.lower + box.upper) / 2
    if bool(convex.contains(middle)):
        return np.asarray(middle, dtype=float)
    vertices = getattr(convex, "vertices", None)
    return convex.interior_point() if vertices is None else np.asarray(vertices, dtype=float).mean(axis=0)


def _groups(given: object, controls: int, weights: Array) -> tuple[tuple[int, ...], ...] | None:
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
        whole = isinstance(channel, int | np.integer) and not isinstance(channel, bool)
        if not whole or not 1 <= channel <= controls:
            raise InputError(path="group", expected=f"channels from 1 to {controls}", got=f"{channel!r}")
    if len(set(channels)) < len(channels) or not all(groups):
        raise InputError(
            path="group",
            expected="every channel in one group at most, and no group empty",
            got=f"{[list(map(int, group)) for group in groups]}",
        )
    found = tuple(tuple(int(channel) for channel in group) for group in groups)
    for group in found:
        own = by_time(weights)[1].T[np.array(group) - 1]
        if (own != own[0]).any():
            raise InputError(
                path="group",
                expected="equal weights within a group",
                got=f"{np.squeeze(own, axis=-1 if own.shape[1] == 1 else ()).tolist()} for {list(group)}",
            )
    return found


def _term(key: str, given: object, letter: str, size: int) -> Quadratic | None:
    """One quadratic term from ``{letter: matrix, reference: vector}``."""
    if given is None:
        return None
    reference: object
    if isinstance(given, Quadratic):
        matrix, reference = given.Q, given.reference
    elif isinstance(given, Mapping):
        known = {letter} if key == "control" else {letter, "reference"}
        if letter not in given or not set(given) <= known:
            raise InputError(path=key, expected=f"{{{', '.join(sorted(known))}}}", got=f"{sorted(map(str, given))}")
        matrix, reference = given[letter], given.get("reference")
    else:
        raise InputError(path=key, expected=f"a mapping with {letter}", got=f"{type(given).__name__}")
    of = "control" if key == "control" else "state"
    Q = _numbers(
        f"{key}.{letter}", matrix, (size, size), f"a {size} by {size} matrix of finite numbers, a row per {of}"
    )
    r = np.zeros(size)
    if reference is not None:
        r = _numbers(f"{key}.reference", reference, (size,), f"{size} finite numbers, one per {of}")
    return Quadratic(_semidefinite(f"{key}.{letter}", Q), r)


def _numbers(path: str, given: object, shape: tuple[int, ...], expected: str) -> Array:
    try:
        array = np.asarray(dense(given), dtype=float)
    except (TypeError, ValueError):
        raise InputError(path=path, expected=expected, got=f"{given!r}") from None
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(path=path, expected=expected, got=f"{array.tolist()}")
    return array + 0.0


def _semidefinite(path: str, Q: Array) -> Array:
    """A symmetric positive semidefinite matrix, or one that is but for rounding, which is then made so: the checker
    shows it in fractions."""
    form = require_convex(path, Q, Q.shape[0])
    Q, diagonal = form.toarray(), form.diagonal()
    small, kept = ROUNDED * Q.shape[0], np.flatnonzero(diagonal > 0.0)
    if form.nnz == np.count_nonzero(diagonal) or (Q.shape[0] <= EXACT and _exactly_semidefinite(Q)):
        return Q
    if is_definite(form[kept][:, kept], 1.0 - 2.0 * small):
        return Q
    return Q + np.diag(4.0 * small * diagonal)


def _exactly_semidefinite(Q: Array) -> bool:
    """Symmetric elimination in fractions: no pivot is negative, and none is 0 beside an entry that is not."""
    rows = [[Fraction(float(entry)) for entry in row] for row in Q]
    for k in range(len(rows)):
        pivot = rows[k][k]
        if pivot < 0 or (pivot == 0 and any(rows[k][k + 1 :])):
            return False
        for i in range(k + 1, len(rows)):
            if pivot and rows[i][k]:
                factor = rows[i][k] / pivot
                rows[i] = [entry - factor * other for entry, other in zip(rows[i], rows[k], strict=True)]
    return True


def checked_weights(given: npt.ArrayLike | None, controls: int, horizon: float) -> Array:
    """Weights ``(m,)``, all positive, or rows ``(r, 1 + m)`` of a time and the weights from then on, none negative. A
    number serves every control, ``None`` is 1; a single row of positive weights is ``(m,)``.

    The rows begin at 0, their times increase, and the last one is before the ``horizon``. Raises `InputError`.
    """
    given = 1.0 if given is None else given
    if isinstance(given, str | bytes) or not _is_nested(given):
        weights = as_bound("weights", given, controls)
        if not ((weights > 0.0) & np.isfinite(weights)).all():
            raise InputError(
                path="weights", expected=f"{controls} positive numbers, one per control", got=f"{weights.tolist()}"
            )
        return weights
    rows = _rows(given, controls, horizon)
    return rows[0, 1:] if len(rows) == 1 and (rows[0, 1:] > 0.0).all() else rows


def _is_nested(given: npt.ArrayLike) -> bool:
    if isinstance(given, np.ndarray):
        return given.ndim > 1
    return isinstance(given, list | tuple) and any(isinstance(row, list | tuple | np.ndarray) for row in given)


def _rows(given: npt.ArrayLike, controls: int, horizon: float) -> Array:
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
    """The times ``(r,)`` from which `checked_weights` count, the first of them 0, and these, ``(r, m)``."""
    rows = np.asarray(weights, dtype=float)
    return (np.zeros(1), rows[None]) if rows.ndim == 1 else (rows[:, 0], rows[:, 1:])


def integrals(weights: object, breakpoints: Array) -> Array:
    """The integrals ``(m, K)`` of the weights over the pieces between ``breakpoints (K + 1,)``, also where they change
    within a piece: exact but for the rounding of the sums."""
    times, values = by_time(weights)
    begins, ends = breakpoints[:-1], breakpoints[1:]
    if times.size == 1:
        return np.outer(values[0], ends - begins)
    overlap = np.minimum(ends, np.append(times[1:], np.inf)[:, None]) - np.maximum(begins, times[:, None])
    return np.asarray(values.T @ np.maximum(overlap, 0.0))


def counted(weights: object) -> Array:
    """What a control counts per time that it acts ``(m,)``: its weight, and 1 where weights change with time, since
    activity counts time and not what it costs."""
    rows = np.asarray(weights, dtype=float)
    return rows if rows.ndim == 1 else np.ones(rows.shape[1] - 1)


def weights_between(weights: object, begin: float, horizon: float) -> Array:
    """The weights of the times from ``begin`` on for as long as ``horizon``, with times that are counted from
    ``begin``."""
    rows = np.asarray(weights, dtype=float)
    if rows.ndim == 1:
        return rows
    kept = rows[int(np.searchsorted(rows[:, 0], begin, side="right")) - 1 :].copy()
    kept[:, 0] = np.maximum(kept[:, 0] - begin, 0.0)
    return kept[kept[:, 0] < horizon]


WEIGHTS = timed(lambda of: of.cost / (of.controls * of.time), weights_between)
