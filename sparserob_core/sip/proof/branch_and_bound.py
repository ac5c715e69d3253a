"""Proof over the continuum: branch and bound on the violation of every constraint family."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.errors import NotEnclosable
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import Notify, ProofProgress, ignore
from sparserob_core.sip.evidence import Proof
from sparserob_core.sip.limits.deadline import Deadline, OutOfTime
from sparserob_core.sip.program import TOLERANCE, ConstraintFamily, SemiInfiniteProgram, Separation

MAX_PROOF_CELLS = 400_000  # cells examined per family before the proof is given up
BATCH = 4096  # cells bounded at a time
PROBED = 16  # number of worst cells at whose centres a witness is sought
# Rounds of bounding, from 1, in which an ascent also searches for a witness: a cell's centre may be far from the worst
# corner of a set.
CLIMBED = (
    3,
    6,
    10,
    15,
    20,
    30,
)
FIRST_BATCH, QUICK = 16, 0.25  # cells bounded first, and the seconds that a batch may take, where time is limited
SECONDS_PER_EVENT = 1.0  # seconds between events within a round of bounding
STALLED, ADVANCED = 30.0, 0.99  # a proof is stuck if its worst bound has not fallen to this share within these seconds
MORE = "more seconds (limits.seconds) would help"
ADVICE = "a larger method.tolerance would help, as it keeps decisions farther away, or narrower index sets"
SHARPENING_ROUNDS = 3  # rounds for sharper bounds than a proof needs: ten more follow violations to their last digits
# Halvings without progress after which the difference between bound and violation counts as rounding, and the largest
# such difference, or such bound, in the units of the rows.
REST, TINY = 8, 1e-5
# Share of the excess of a tiny bound that may still fall with the size of a cell. With ten times as much, a proof
# reports a larger bound than necessary, and decisions keep a larger distance; with a tenth, more cells are needed.
FALLING = 0.06
MAX_ASCENT_STEPS = 24  # largest number of steps of such an ascent
MAX_CUT = 32  # largest number of open cells that are divided towards peaks
SHARE, GROWN = 0.8, (1 / 16, 1.0)  # share of the allowed length of such parts; relative growth from part to part
_NOWHERE = Separation(np.zeros((0, 1)), np.zeros(0, dtype=int), np.zeros(0))


def prove(
    program: SemiInfiniteProgram,
    x: Array,
    notify: Notify = ignore,
    cells: int | Mapping[str, int] = MAX_PROOF_CELLS,
    deadline: Deadline | None = None,
) -> tuple[Proof, ...]:
    """Prove or refute every family at a decision.

    Past the deadline, only the first cells of each family are bounded, once. Families for which there is no time at all
    are undecided.

    Parameters
    ----------
    program : SemiInfiniteProgram
        The program.
    x : ndarray, shape (n,)
        The decision.
    notify : callable
        Receives events; by default events are ignored.
    cells : int or mapping of str to int, default CELLS
        Largest number of cells for each family, or these numbers by the names of families.
    deadline : Deadline, optional
        Time at which the proof ends.

    Returns
    -------
    tuple of Proof
        One proof for each family.
    """
    time_left = deadline or Deadline()
    budgets = {
        family.name: cells if isinstance(cells, int) else cells.get(family.name, 0) for family in program.families
    }
    families = [family.reduced or family for family in program.families]
    proofs: list[tuple[ConstraintFamily, Proof]] = []
    try:
        proofs.extend((family, _prove(family, x, notify, budgets[family.name], time_left)) for family in families)
    except OutOfTime as error:  # there is no time to bound the remaining families even once
        proofs += [(family, _report_interrupted(family, error, time_left)) for family in families[len(proofs) :]]
    return tuple(
        replace(
            proof,
            formulation=family.formulation,
            unit=family.row_unit(proof.row),
            measured=family.measure(proof.row),
            allowed=family.allowed(x),
        )
        for family, proof in proofs
    )


def supremum(
    family: ConstraintFamily,
    x: Array,
    tolerance: float,
    least: float = 0.0,
    notify: Notify = ignore,
    cells: int = MAX_PROOF_CELLS,
    deadline: Deadline | None = None,
) -> Supremum:
    """Enclose the largest violation of a family over its whole index set.

    A proof stops at the first violation; this function computes the largest one. A cell is closed where its enclosure
    is within ``tolerance`` times the largest violation found so far, or times ``least`` where that is larger. Past the
    deadline, or after ``cells`` cells, the two bounds are farther apart, but they hold.

    Parameters
    ----------
    family : ConstraintFamily
        The family.
    x : ndarray, shape (n,)
        The decision.
    tolerance : float
        Relative tolerance.
    least : float, default 0
        Smallest size to which the tolerance is relative.
    notify : callable
        Receives events.
    cells : int, default CELLS
        Largest number of cells.
    deadline : Deadline, optional
        Time at which the search ends.

    Returns
    -------
    Supremum
        A violation that an index attains, and a proven upper bound.

    Raises
    ------
    NotEnclosable
        For a family that offers no enclosure.
    """
    if family.enclosure is None:
        raise NotEnclosable(f"{family.name} offers no enclosure")
    course = Course(family, notify, cells, deadline or Deadline())
    return _branch_and_bound(family, x, course, Within(tolerance, least))[1]


def prove_family(
    family: ConstraintFamily,
    x: Array,
    notify: Notify = ignore,
    cells: int = MAX_PROOF_CELLS,
    deadline: Deadline | None = None,
) -> Proof:
    """Bound the violation of one family over its whole index set.

    Cells whose enclosure is at most `ConstraintFamily.allowed` are closed, the others halved. The centres of the worst
    cells are probed for a witness. Where that takes long, an ascent searches for one. At the deadline, or after an
    interrupt from the keyboard, which the deadline records, the proof ends undecided, with the bound reached.

    Parameters
    ----------
    family : ConstraintFamily
        The family.
    x : ndarray, shape (n,)
        The decision.
    notify : callable
        Receives events.
    cells : int, default CELLS
        Largest number of cells.
    deadline : Deadline, optional
        Time at which the proof ends.

    Returns
    -------
    Proof
        The verdict on the family.
    """
    time_left = deadline or Deadline()
    try:
        return _prove(family, x, notify, cells, time_left)
    except OutOfTime as error:
        return _report_interrupted(family, error, time_left)


def _prove(family: ConstraintFamily, x: Array, notify: Notify, cells: int, deadline: Deadline) -> Proof:
    """Return the proof of one family; raise `OutOfTime` where the deadline interrupts a step.

    An interrupt from the keyboard is recorded in the deadline, and the family is undecided.
    """
    try:
        if family.enclosure is None:
            return _prove_by_separation(family, x)
        try:
            course = Course(family, notify, cells, deadline)
            return _branch_and_bound(family, x, course, NoViolation(family.allowed(x), family.sharpness))[0]
        except NotEnclosable as error:
            if deadline.passed:
                return Proof(family.name, "undecided", np.inf, reason=f"{family.name}: {error}")
            return replace(_prove_by_separation(family, x), reason=f"{family.name}: {error}")
    except OutOfTime:
        raise
    except KeyboardInterrupt as error:
        return _report_interrupted(family, error, deadline)


def _report_interrupted(family: ConstraintFamily, error: KeyboardInterrupt, deadline: Deadline) -> Proof:
    """Return the undecided proof of a family that was interrupted, and record the interrupt in the deadline."""
    deadline.interrupt(error)
    reason = f"{family.name}: its proof had begun only; {more(deadline)}"
    return Proof(family.name, "undecided", np.inf, reason=reason)


def more(deadline: Deadline) -> str:
    """Return in words the remedy where time is over: a larger limit or, after an interrupt, more time."""
    return MORE if deadline.bounded and not deadline.pressed else "more time would help"


@dataclass(eq=False)
class Course:
    """Progress of the proof of one family: the cells examined of its budget, and the fall of its worst bound.

    Parameters
    ----------
    family : ConstraintFamily
        The family.
    notify : callable
        Receives events.
    budget : int
        Largest number of cells.
    deadline : Deadline
        Time at which the proof ends.
    started, told : float
        Time of the start and of the last event, in seconds.
    examined : int
        Number of cells bounded so far.
    fall : deque of (float, float)
        Times and worst bounds of the last half minute.
    """

    family: ConstraintFamily
    notify: Notify
    budget: int
    deadline: Deadline
    started: float = field(default_factory=time.perf_counter)
    told: float = field(default_factory=time.perf_counter)
    examined: int = 0
    fall: deque[tuple[float, float]] = field(default_factory=deque)
    along: str = ""
    """Part of the first coordinate, the time of a path constraint, in which cells are open, in words."""

    def opened(self, lower: Array, upper: Array) -> None:
        """Record the length and the range of the first coordinate that the open cells, with corners ``(k, d)``,
        cover."""
        factor = 1.0 if self.family.index_units is None else float(self.family.index_units[0])
        ends, box = factor * np.stack([lower[:, 0], upper[:, 0]]), self.family.index_set
        length = factor * float(box.upper[0] - box.lower[0]) if box.dimension else 0.0
        if length <= 0.0 or not np.isfinite(length):
            return
        first = np.argsort(ends[0], kind="stable")
        starts, furthest = ends[0, first], np.maximum.accumulate(ends[1, first])
        covered = float(np.maximum(furthest - np.maximum(starts, np.append(starts[0], furthest[:-1])), 0.0).sum())
        unit = f" {self.family.along}" if self.family.along else ""
        self.along = f"open along {covered:.3g} of {length:.3g}{unit}, from {starts[0]:.5g} to {furthest[-1]:.5g}{unit}"

    def tell(self, cells: int, bound: float, lower: Array, upper: Array, pending: int = 0) -> None:
        """Send an event about the open cells.

        Parameters
        ----------
        cells : int
            Number of open cells.
        bound : float
            Bound of the worst of them.
        lower, upper : ndarray, shape (d,)
            Corners of the worst cell.
        pending : int, default 0
            Number of cells that were examined since the last count.
        """
        now = time.perf_counter()
        self.fall.append((now, bound))
        while len(self.fall) > 1 and self.fall[1][0] <= now - STALLED:
            self.fall.popleft()
        before = self.fall[0][1] if self.fall[0][0] <= now - STALLED else np.nan
        self.told = now
        self.notify(
            ProofProgress(
                family=self.family.name,
                cells=cells,
                bound=bound,
                seconds=now - self.started,
                examined=self.examined + pending,
                budget=self.budget,
                bound_before=before,
                hindrance="" if not bound >= ADVANCED * before else self.hindrance(bound, lower, upper),
                measured=self.family.measure(),
            )
        )

    def hindrance(self, bound: float, lower: Array, upper: Array) -> str:
        """Return in words what hinders the proof at the worst cell, and a remedy, in the user's units."""
        advice = "" if self.family.hindrance is None else self.family.hindrance(lower, upper)
        if self.deadline.passed:
            advice = f"there was no time to halve it; {more(self.deadline)}, or a larger method.tolerance"
        units = self.family.index_units
        lower, upper = (lower, upper) if units is None or units.size != lower.size else (lower * units, upper * units)
        allowed = bound * (1.0 if self.family.row_units is None else float(self.family.row_units.max()))
        cell = f"the cell from {_format_point(lower)} to {_format_point(upper)} still allows {allowed:.1e}"
        cell += f" {self.family.measure()}" if self.family.measure() else ""
        cell = f"{self.along}; {cell}" if self.along else cell
        return f"{self.family.name}: {cell}; {advice or ADVICE}"


@dataclass(frozen=True)
class NoViolation:
    """Goal of a proof: to decide whether anything is violated by more than ``allowed``.

    Cells are closed where nothing is, and a violation of more than `TOLERANCE` ends the search. A violation between the
    two may be rounding. Cells are closed at the share ``sharpness`` of ``allowed``, until that alone has kept cells
    open for `SHARPENING_ROUNDS` rounds.
    """

    allowed: float = TOLERANCE
    sharpness: float = 1.0

    def closes(self, best: float, rounds: int = 0) -> float:
        """Return the bound up to which a cell is closed, after so many ``rounds`` in which only sharpness was missing;
        ``best`` is the largest violation found."""
        return self.sharpness * self.allowed if rounds < SHARPENING_ROUNDS else self.allowed

    def ends(self, best: float) -> bool:
        """Return whether the largest violation found decides the question."""
        return best > TOLERANCE


@dataclass(frozen=True)
class Within:
    """Goal of a supremum: the largest violation, to a ``tolerance`` relative to it, or to ``least`` where that is
    larger."""

    tolerance: float
    least: float

    def closes(self, best: float, rounds: int = 0) -> float:
        """Return the bound up to which a cell is closed, where ``best`` is the largest violation found."""
        return best + self.tolerance * max(abs(best), self.least)

    def ends(self, best: float) -> bool:
        """Return false: a supremum is known only when all cells are closed."""
        return False


@dataclass(frozen=True, eq=False)
class Supremum:
    """Enclosure of the largest violation of a family over its whole index set.

    Parameters
    ----------
    lower : float
        Violation of ``row`` at ``index``.
    upper : float
        Upper bound, proven over the continuum.
    index : ndarray, shape (d,)
        Index that attains ``lower``.
    row : int
        Row that attains ``lower``.
    cells : int
        Number of cells bounded.
    leaves : tuple of ndarray
        Lower and upper corners ``(k, d)`` of the cells that prove the bound, and their bounds ``(k,)``.
    reason : str
        Reason why the two bounds are farther apart than required; empty where they are not.
    """

    lower: float
    upper: float
    index: Array
    row: int
    cells: int
    leaves: tuple[Array, Array, Array]
    reason: str = ""

    __repr__ = brief


def _branch_and_bound(
    family: ConstraintFamily, x: Array, course: Course, goal: NoViolation | Within
) -> tuple[Proof, Supremum]:
    """Return what is known of one family after branch and bound, as a proof and as a supremum."""
    box = family.index_set
    lower, upper = family.partition
    best, parent_bounds = (-np.inf, lower[0], 0), np.full(lower.shape[0], np.inf)
    leaves: list[tuple[Array, Array, Array]] = []  # one entry per halving
    slacks: list[float] = []
    rest = 0  # rounds in which bounds were good enough, and not sharp

    while True:
        # Bound every cell, and close those where no violation is left.
        bounds, split, bend = _bound_cells(course, x, lower, upper)
        bounds = np.minimum(bounds, parent_bounds)  # a part violates no more than the whole
        course.examined += bounds.size
        rest += int(bounds.max(initial=-np.inf) <= goal.closes(best[0], SHARPENING_ROUNDS))
        open_ = bounds > goal.closes(best[0], rest)

        # Search for a witness: where separation finds the largest violations, and in the worst cells.
        first, peaks = not leaves, _NOWHERE
        if first and bend is not None and family.worst is not None:
            peaks = family.separated(x)
        if peaks.violations.size:
            best = (float(peaks.violations[0]), peaks.indices[0], int(peaks.rows[0]))
        elif first or open_.any():
            best = max(best, _probe(family, x, lower, upper, bounds), key=lambda witness: witness[0])
        if open_.any() and not goal.ends(best[0]) and len(leaves) + 1 in CLIMBED and box.dimension > 1:
            worst_cell = (corner[bounds.argmax()] for corner in (lower, upper))
            best = max(best, _climb(family, x, *worst_cell), key=lambda witness: witness[0])
        open_ = bounds > goal.closes(best[0], rest)
        leaves.append((lower[~open_], upper[~open_], bounds[~open_]))
        if goal.ends(best[0]):
            return _form_answers(course, "refuted", best, leaves)
        if not open_.any():
            return _form_answers(course, "proven", best, leaves)

        # Divide the open cells, as long as their number, their width and the time allow: once towards the peaks, then
        # into halves. Rows at their worst deviations have kinks, not smooth peaks.
        worst, at = float(bounds.max()), int(bounds.argmax())
        course.opened(lower[open_], upper[open_])
        course.tell(int(open_.sum()), worst, lower[at], upper[at])
        low, high = lower[open_], upper[open_]
        children = (
            None
            if bend is None or family.uncertain is not None
            else _divide_towards_peaks(peaks, low, high, bounds[open_], bend[open_])
        )
        if children is None or course.examined + children[0].shape[0] > course.budget:
            children, parent_bounds = _halve_cells(low, high, split[open_]), np.tile(bounds[open_], 2)
        else:
            parent_bounds = np.full(children[0].shape[0], np.inf)
        slacks.append(worst - best[0])
        is_spent = children is None or course.examined + children[0].shape[0] > course.budget or course.deadline.passed
        is_rounding = (
            box.dimension == 1 and bend is not None and _is_rounding(worst, float(bend[at]), goal.closes(best[0], rest))
        )
        if children is None or is_spent or is_rounding or _is_stalled(slacks):
            hindrance = course.hindrance(worst, lower[at], upper[at])
            leaves.append((low, high, bounds[open_]))
            reason = f"{int(open_.sum())} of {course.examined} cells were left; {hindrance}"
            return _form_answers(course, "undecided", best, leaves, reason)
        lower, upper = children


def _form_answers(
    course: Course,
    verdict: Literal["proven", "refuted", "undecided"],
    best: tuple[float, Array, int],
    leaves: list[tuple[Array, Array, Array]],
    reason: str = "",
) -> tuple[Proof, Supremum]:
    """Return the proof and the supremum, where ``best`` was found and ``leaves`` were closed, or left open if
    undecided."""
    lower, upper, bounds = _sort_leaves(leaves)
    top, name, (violation, index, row) = float(bounds.max(initial=-np.inf)), course.family.name, best
    proof = Proof(
        name,
        verdict,
        np.inf if verdict == "refuted" else top,
        violation,
        index,
        row,
        course.examined,
        reason,
        leaves=(lower, upper) if verdict == "proven" else None,
    )
    cells = lower, upper, bounds
    return proof, Supremum(violation, max(top, violation), index, row, course.examined, cells, reason)


def _is_stalled(slacks: Sequence[float]) -> bool:
    """Return whether the worst bound no longer approaches the largest violation found as cells shrink.

    Only a difference of at most `TINY` is judged; it then counts as rounding.
    """
    return len(slacks) > 2 * REST and slacks[-1] <= TINY and slacks[-1] > ADVANCED * slacks[-1 - REST]


def _is_rounding(bound: float, bend: float, limit: float) -> bool:
    """Return whether the excess of a tiny bound over the ``limit`` counts as rounding, for a cell with one coordinate.

    At most the share `FALLING` of such an excess falls with the cell's width. The rest comes from the values at the
    cell's ends, so that no shorter cell with that end is closed.
    """
    return bound <= TINY and bend <= FALLING * (bound - limit)


def _bound_cells(course: Course, x: Array, lower: Array, upper: Array) -> tuple[Array, Array, Array | None]:
    """Return bounds ``(k,)`` of cells, the coordinates ``(k,)`` to halve, and the parts ``(k,)`` quadratic in the
    widths.

    The last is ``None`` where it is not known. Bounds are infinite for cells for which there was no time. Cells are
    bounded in batches, so that memory does not grow with their number. Only where a deadline is set do the batches
    depend on the time that they take: the cost of a cell is not known before, and a result without a limit must not
    depend on the speed of the machine. Cells that differ only in their first coordinate share work, so they follow one
    another.
    """
    family, count = course.family, lower.shape[0]
    bounds, split, bend = np.full(count, np.inf), (upper - lower).argmax(axis=1), np.full(count, np.inf)
    has_bend, hurried = True, course.deadline.bounded or course.deadline.passed
    start, size = 0, FIRST_BATCH if hurried else BATCH
    order, ends = _group_cells(lower, upper) if count > size else (np.arange(count), np.array([count]))
    while start < count and not (start and course.deadline.passed):
        started, stop = time.perf_counter(), min(start + size, count)
        if hurried:  # to the end of the group that shares work, unless that is far
            stop = min(int(ends[np.searchsorted(ends, stop)]), start + BATCH)
        batch = order[start:stop]
        enclosed = family.enclosed(x, lower[batch], upper[batch])
        bounds[batch] = enclosed.bounds
        split[batch] = enclosed.split
        has_bend = has_bend and enclosed.bend is not None
        bend[batch] = np.inf if enclosed.bend is None else enclosed.bend
        start, ended = stop, time.perf_counter()
        if course.deadline.bounded:
            size = min(BATCH, 2 * size) if ended - started < QUICK else max(1, size // 2)
        if start < count and ended - course.told > SECONDS_PER_EVENT:
            at = order[bounds[order[:start]].argmax()]
            course.tell(count, float(bounds[at]), lower[at], upper[at], start)
    return bounds, split, bend if has_bend else None


def _group_cells(lower: Array, upper: Array) -> tuple[np.ndarray, np.ndarray]:
    """Return an order ``(k,)`` of cells that groups those that differ in their first coordinate only, and the ends of
    groups.

    Cells with no other coordinate keep their order, and each may be an end.
    """
    count = lower.shape[0]
    if lower.shape[1] == 1:
        return np.arange(count), np.arange(1, count + 1)
    _, groups = np.unique(np.hstack([lower[:, 1:], upper[:, 1:]]), axis=0, return_inverse=True)
    order = np.argsort(groups.reshape(-1), kind="stable")
    return order, np.append(np.flatnonzero(np.diff(groups.reshape(-1)[order])) + 1, count)


def _divide_towards_peaks(
    peaks: Separation, lower: Array, upper: Array, bounds: Array, bend: Array
) -> tuple[Array, Array] | None:
    """Return cells ``(k, 1)`` after a division towards the peaks of the violation; ``None`` where it does not apply.

    A cell near or around a peak is divided at once into parts that are short at the peak and longer with the distance
    from it. The others are halved. ``None`` is returned where no cell would be divided so, where too many are open, and
    where a part would be too short for floating point.

    Take the part from ``D`` to ``(1 + g) D`` next to a smooth peak of height ``v`` and curvature ``c``, with the bound
    ``b`` of the second derivative. Its bound is about ``v - c D^2 / 2 + b (g D)^2 / 8``. So ``g = 2 sqrt(c / b)``
    suffices.
    """
    if not peaks.violations.size or lower.shape[0] > MAX_CUT:
        return None
    starts, stops = list[Array](), list[Array]()
    reach = np.clip(peaks.indices[:, 0], lower, upper)
    away = np.abs(reach - peaks.indices[:, 0])
    for i, nearest in enumerate(away.argmin(axis=1)):
        low, high, at, top = lower[i, 0], upper[i, 0], reach[i, nearest], peaks.violations[nearest]
        width = high - low
        short = SHARE / 2 * width * np.sqrt(max(TOLERANCE - top, TOLERANCE / 16) / max(bend[i], TOLERANCE))
        cuts = np.array([low, (low + high) / 2, high])
        if away[i, nearest] <= width and 0.0 < short < width / 4:
            inside, grow = min(at - low, high - at), 0.5
            if inside > width / 8:  # the peak is higher than the ends by half its curvature times the squared distance
                curvature_ratio = max(top - (bounds[i] - bend[i]), 0.0) / bend[i] * (width / inside) ** 2 / 4
                grow = float(np.clip(2 * SHARE * np.sqrt(curvature_ratio), *GROWN))
            offsets = short * (1 + grow) ** np.arange(np.ceil(np.log(width / short) / np.log1p(grow)))
            cuts = np.concatenate([[low], at - offsets[::-1], at + offsets, [high]])
            cuts = np.concatenate([[low], cuts[(cuts > low) & (cuts < high)], [high]])
        if not (np.diff(cuts) > 0.0).all():
            return None
        starts.append(cuts[:-1])
        stops.append(cuts[1:])
    if all(start.size == 2 for start in starts):
        return None
    return np.concatenate(starts)[:, None], np.concatenate(stops)[:, None]


def _probe(family: ConstraintFamily, x: Array, lower: Array, upper: Array, bounds: Array) -> tuple[float, Array, int]:
    """Return the largest violation at the centres of the worst cells, its index and its row."""
    worst = np.argsort(-bounds, kind="stable")[:PROBED]
    centres = (lower[worst] + upper[worst]) / 2
    values = family.violations(x, centres)
    position, row = np.unravel_index(int(values.argmax()), values.shape)
    return float(values[position, row]), centres[position], int(row)


def _climb(family: ConstraintFamily, x: Array, lower: Array, upper: Array) -> tuple[float, Array, int]:
    """Return the largest violation that an ascent from the middle of one cell finds, its index and its row.

    Its steps are along every axis, and along all axes together.
    """
    box, point, radius = family.index_set, (lower + upper) / 2, upper - lower
    best = (-np.inf, point, 0)
    for _ in range(MAX_ASCENT_STEPS):
        star = np.clip(np.vstack([point, point + np.diag(radius), point - np.diag(radius)]), box.lower, box.upper)
        values = family.violations(x, star)
        ahead, behind = values[1:].max(axis=1).reshape(2, -1)
        together = np.clip(point + np.sign(ahead - behind) * radius, box.lower, box.upper)[None]
        star, values = np.vstack([star, together]), np.vstack([values, family.violations(x, together)])
        position, row = (int(i) for i in np.unravel_index(int(values.argmax()), values.shape))
        if values[position, row] > best[0]:
            best = (float(values[position, row]), star[position], row)
        else:
            radius = radius / 2
        point = best[1]
    return best


def _sort_leaves(leaves: list[tuple[Array, Array, Array]]) -> tuple[Array, Array, Array]:
    """Return the corners of all leaves, sorted by lower and then by upper corners, and their bounds."""
    lower, upper, bounds = (np.concatenate(arrays) for arrays in zip(*leaves, strict=True))
    order = np.lexsort(np.hstack([lower, upper]).T[::-1])
    return lower[order], upper[order], bounds[order]


def _halve_cells(lower: Array, upper: Array, split: Array) -> tuple[Array, Array] | None:
    """Return both halves of every cell along its coordinate ``split``; ``None`` where a cell is too narrow for floating
    point."""
    rows = np.arange(split.size)
    middle = (lower[rows, split] + upper[rows, split]) / 2
    if ((middle <= lower[rows, split]) | (middle >= upper[rows, split])).any():
        return None
    left_upper, right_lower = upper.copy(), lower.copy()
    left_upper[rows, split] = middle
    right_lower[rows, split] = middle
    return np.vstack([lower, right_lower]), np.vstack([left_upper, upper])


def _prove_by_separation(family: ConstraintFamily, x: Array) -> Proof:
    """Return the proof of a family without an enclosure, from its separation.

    A bound that the separation states is believed, except where the rows at two corners of the index set contradict it.
    A violation of more than `TOLERANCE` refutes the family. Otherwise the family stays undecided.
    """
    if family.worst is None:
        return Proof(
            family.name,
            "undecided",
            np.inf,
            reason=f"family {family.name} offers no enclosure, so nothing can be excluded",
        )
    separation = family.separated(x)
    violation = float(separation.violations[0]) if separation.violations.size else -np.inf
    index, row = (separation.indices[0], int(separation.rows[0])) if separation.violations.size else (None, 0)
    ends = np.stack([family.index_set.lower, family.index_set.upper])
    witness = _probe(family, x, ends, ends, np.zeros(2)) if np.isfinite(ends).all() else (-np.inf, ends[0], 0)
    if witness[0] > max(violation, TOLERANCE):  # the separation is believed, but not against the family's own rows
        violation, index, row = witness
    if violation > TOLERANCE:
        return Proof(family.name, "refuted", np.inf, violation, index, row)
    if separation.bound <= family.allowed(x):
        return Proof(family.name, "proven", separation.bound, violation, index, row)
    return Proof(
        family.name,
        "undecided",
        separation.bound,
        violation,
        index,
        row,
        reason=f"family {family.name} offers no enclosure, so nothing can be excluded",
    )


def _format_point(point: Array) -> str:
    """Return a point as a short text."""
    return np.array2string(point, precision=4, separator=", ", threshold=8)
