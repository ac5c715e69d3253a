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

CELLS = 400_000  # cells examined per family before the proof is given up
BATCH = 4096  # cells bounded at a time, worst first
PROBED = 16  # centres of the worst cells at which a witness is looked for, per batch
# halvings after which a witness is also climbed to: a cell's centre may be far from the worst corner of a set
CLIMBED = (
    3,
    6,
    10,
    15,
    20,
    30,
)
FIRST_BATCH, QUICK = 16, 0.25  # cells bounded first, and the seconds that a batch may take, where time is limited
OFTEN = 1.0  # seconds after which a batch that is not over is told of
STALLED, ADVANCED = 30.0, 0.99  # a worst bound that has not fallen below this share within so many seconds is stuck
MORE = "more seconds (limits.seconds) would help"
ADVICE = "a larger method.tolerance would help, as it keeps decisions farther away, or narrower index sets"
REST, TINY = 8, 1e-5  # halvings without progress after which a bound below `TINY` of its unit is taken for rounding
# Of what a tiny bound is too large by, what may still fall with a cell. With ten times as much, what a proof leaves
# open is told as more than it is, and decisions are kept away by as much; with a tenth there are as many cells more.
FALLING = 0.06
MOVES = 24  # steps of such a climb at most
MOST_CUT = 32  # open cells that are cut towards peaks
SHARE, GROWN = 0.8, (1 / 16, 1.0)  # of what such parts may be long; how much longer each is than the one before
_NOWHERE = Separation(np.zeros((0, 1)), np.zeros(0, dtype=int), np.zeros(0))


def prove(
    program: SemiInfiniteProgram,
    x: Array,
    notify: Notify = ignore,
    cells: int | Mapping[str, int] = CELLS,
    deadline: Deadline | None = None,
) -> tuple[Proof, ...]:
    """Prove or refute every family at ``x (n,)``, one `Proof` each; past the deadline with one look at each.
    ``cells`` may be examined of each at most, or as many as are told by the names of families."""
    time_left = deadline or Deadline()
    budgets = {
        family.name: cells if isinstance(cells, int) else cells.get(family.name, 0) for family in program.families
    }
    proven = [family.reduced or family for family in program.families]
    found: list[tuple[ConstraintFamily, Proof]] = []
    try:
        found.extend((one, _prove(one, x, notify, budgets[one.name], time_left)) for one in proven)
    except OutOfTime as error:  # of families that are left not even one look would come to its end
        found += [(one, _begun_only(one, error, time_left)) for one in proven[len(found) :]]
    return tuple(
        replace(
            proof,
            formulation=one.formulation,
            unit=one.row_unit(proof.row),
            measured=one.measure(proof.row),
            allowed=one.allowed(x),
        )
        for one, proof in found
    )


def supremum(
    family: ConstraintFamily,
    x: Array,
    tolerance: float,
    least: float = 0.0,
    notify: Notify = ignore,
    cells: int = CELLS,
    deadline: Deadline | None = None,
) -> Supremum:
    """The largest violation of a family over its whole index set, between one that an index reaches and a proven bound:
    the proof that stops at a violation is asked for a number.

    A cell is closed where its enclosure is within ``tolerance`` times the best violation met so far, or times ``least``
    where that is larger. Past the deadline, or when ``cells`` were examined, the two sides are farther apart, and hold
    all the same. Raises `NotEnclosable` for a family that offers no enclosure.
    """
    if family.enclosure is None:
        raise NotEnclosable(f"{family.name} offers no enclosure")
    course = Course(family, notify, cells, deadline or Deadline())
    return _branch_and_bound(family, x, course, Within(tolerance, least))[1]


def prove_family(
    family: ConstraintFamily, x: Array, notify: Notify = ignore, cells: int = CELLS, deadline: Deadline | None = None
) -> Proof:
    """Bound the violation of one family over its whole index set.

    Cells whose enclosure is at most `ConstraintFamily.allowed` are closed, the others halved; the centres of the worst
    are probed for a witness, and where that takes long one is climbed to. At the deadline, or when it is interrupted
    from the keyboard (of which the deadline takes note), a proof ends undecided, with what is left.
    """
    time_left = deadline or Deadline()
    try:
        return _prove(family, x, notify, cells, time_left)
    except OutOfTime as error:
        return _begun_only(family, error, time_left)


def _prove(family: ConstraintFamily, x: Array, notify: Notify, cells: int, deadline: Deadline) -> Proof:
    """`prove_family`; raises `OutOfTime` where not even one look comes to its end by the deadline."""
    try:
        if family.enclosure is None:
            return _by_separation(family, x)
        try:
            course = Course(family, notify, cells, deadline)
            return _branch_and_bound(family, x, course, NoViolation(family.allowed(x)))[0]
        except NotEnclosable as error:
            if deadline.passed:
                return Proof(family.name, "undecided", np.inf, reason=f"{family.name}: {error}")
            return replace(_by_separation(family, x), reason=f"{family.name}: {error}")
    except OutOfTime:
        raise
    except KeyboardInterrupt as error:
        return _begun_only(family, error, deadline)


def _begun_only(family: ConstraintFamily, error: KeyboardInterrupt, deadline: Deadline) -> Proof:
    """The proof of a family that was interrupted, of which the deadline takes note."""
    deadline.interrupt(error)
    reason = f"{family.name}: its proof had begun only; {more(deadline)}"
    return Proof(family.name, "undecided", np.inf, reason=reason)


def more(deadline: Deadline) -> str:
    """What would help where the time was over: more of the limit, or, where a key was pressed, to wait."""
    return MORE if deadline.bounded and not deadline.pressed else "more time would help"


@dataclass(eq=False)
class Course:
    """How the proof of one family goes on: what it has examined of its budget, and how its worst bound has fallen."""

    family: ConstraintFamily
    notify: Notify
    budget: int
    deadline: Deadline
    started: float = field(default_factory=time.perf_counter)
    told: float = field(default_factory=time.perf_counter)
    examined: int = 0
    fall: deque[tuple[float, float]] = field(default_factory=deque)
    along: str = ""
    """Where along the first coordinate, the time of a path constraint, cells are open: the wall that is ridden."""

    def opened(self, lower: Array, upper: Array) -> None:
        """Note the open cells ``(k, d)``: how much of the first coordinate they cover, and from where to where."""
        factor = 1.0 if self.family.index_units is None else float(self.family.index_units[0])
        ends, box = factor * np.stack([lower[:, 0], upper[:, 0]]), self.family.index_set
        whole = factor * float(box.upper[0] - box.lower[0]) if box.dimension else 0.0
        if whole <= 0.0 or not np.isfinite(whole):
            return
        first = np.argsort(ends[0], kind="stable")
        starts, reached = ends[0, first], np.maximum.accumulate(ends[1, first])
        covered = float(np.maximum(reached - np.maximum(starts, np.append(starts[0], reached[:-1])), 0.0).sum())
        unit = f" {self.family.along}" if self.family.along else ""
        self.along = f"open along {covered:.3g} of {whole:.3g}{unit}, from {starts[0]:.5g} to {reached[-1]:.5g}{unit}"

    def tell(self, cells: int, bound: float, lower: Array, upper: Array, pending: int = 0) -> None:
        """Tell that ``cells`` are open, of which the worst, from ``lower (d,)`` to ``upper (d,)``, has this bound;
        ``pending`` cells have been examined since they were counted."""
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
        """What hinders the proof, and what would help: at the worst cell, in the user's units."""
        advice = "" if self.family.hindrance is None else self.family.hindrance(lower, upper)
        if self.deadline.passed:
            advice = f"there was no time to halve it; {more(self.deadline)}, or a larger method.tolerance"
        known = self.family.index_units
        lower, upper = (lower, upper) if known is None or known.size != lower.size else (lower * known, upper * known)
        allowed = bound * (1.0 if self.family.row_units is None else float(self.family.row_units.max()))
        cell = f"the cell from {_shown(lower)} to {_shown(upper)} still allows {allowed:.1e}"
        cell += f" {self.family.measure()}" if self.family.measure() else ""
        cell = f"{self.along}; {cell}" if self.along else cell
        return f"{self.family.name}: {cell}; {advice or ADVICE}"


@dataclass(frozen=True)
class NoViolation:
    """The question whether anything is violated by more than ``allowed``: cells are closed where nothing is, and a
    violation of more than `TOLERANCE` ends the search. What lies between the two may be rounding."""

    allowed: float = TOLERANCE

    def closes(self, best: float) -> float:
        """The bound up to which a cell is closed, where ``best`` was met."""
        return self.allowed

    def ends(self, best: float) -> bool:
        """Whether what was met answers the question."""
        return best > TOLERANCE


@dataclass(frozen=True)
class Within:
    """The question how large the largest violation is, to a ``tolerance`` relative to it, or to ``least`` where that is
    larger."""

    tolerance: float
    least: float

    def closes(self, best: float) -> float:
        """As `NoViolation.closes`."""
        return best + self.tolerance * max(abs(best), self.least)

    def ends(self, best: float) -> bool:
        """As `NoViolation.ends`."""
        return False


@dataclass(frozen=True, eq=False)
class Supremum:
    """The largest violation of a family, between ``lower``, reached by ``row`` at ``index (d,)``, and ``upper``, proven
    over the continuum. ``reason``: what hindered the two from being as close as was asked for, empty where they are.

    ``leaves``: lower and upper corners ``(k, d)`` of the cells that prove it, and the proven bounds ``(k,)`` there.
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
    """What is known of one family, as an answer to whether anything is violated, and as a number."""
    box = family.index_set
    lower, upper = family.partition
    best, known = (-np.inf, lower[0], 0), np.full(lower.shape[0], np.inf)
    leaves: list[tuple[Array, Array, Array]] = []  # one entry per halving
    slacks: list[float] = []

    while True:
        # Bound every cell, and close those where no violation is left.
        bounds, split, bend = _bounded(course, x, lower, upper)
        bounds = np.minimum(bounds, known)  # a part violates no more than the whole
        course.examined += bounds.size
        open_ = bounds > goal.closes(best[0])

        # Look for a witness: where separation finds the largest violations, and in the worst cells.
        first, peaks = not leaves, _NOWHERE
        if first and bend is not None and family.worst is not None:
            peaks = family.separated(x)
        if peaks.violations.size:
            best = (float(peaks.violations[0]), peaks.indices[0], int(peaks.rows[0]))
        elif first or open_.any():
            best = max(best, _probe(family, x, lower, upper, bounds), key=lambda found: found[0])
        if open_.any() and not goal.ends(best[0]) and len(leaves) + 1 in CLIMBED and box.dimension > 1:
            worst_cell = (corner[bounds.argmax()] for corner in (lower, upper))
            best = max(best, _climb(family, x, *worst_cell), key=lambda found: found[0])
        open_ = bounds > goal.closes(best[0])
        leaves.append((lower[~open_], upper[~open_], bounds[~open_]))
        if goal.ends(best[0]):
            return _answers(course, "refuted", best, leaves)
        if not open_.any():
            return _answers(course, "proven", best, leaves)

        # Cut what is open, as long as cells, their width and time allow: once towards the peaks, then into halves. Rows
        # under the worst deviations have kinks, not peaks that are smooth.
        worst, at = float(bounds.max()), int(bounds.argmax())
        course.opened(lower[open_], upper[open_])
        course.tell(int(open_.sum()), worst, lower[at], upper[at])
        low, high = lower[open_], upper[open_]
        parts = (
            None
            if bend is None or family.uncertain is not None
            else _towards(peaks, low, high, bounds[open_], bend[open_])
        )
        if parts is None or course.examined + parts[0].shape[0] > course.budget:
            parts, known = _halved(low, high, split[open_]), np.tile(bounds[open_], 2)
        else:
            known = np.full(parts[0].shape[0], np.inf)
        slacks.append(worst - best[0])
        spent = parts is None or course.examined + parts[0].shape[0] > course.budget or course.deadline.passed
        rounded = box.dimension == 1 and bend is not None and _is_rounding(worst, float(bend[at]), goal.closes(best[0]))
        if parts is None or spent or rounded or _at_rest(slacks):
            hindrance = course.hindrance(worst, lower[at], upper[at])
            leaves.append((low, high, bounds[open_]))
            reason = f"{int(open_.sum())} of {course.examined} cells were left; {hindrance}"
            return _answers(course, "undecided", best, leaves, reason)
        lower, upper = parts


def _answers(
    course: Course,
    verdict: Literal["proven", "refuted", "undecided"],
    best: tuple[float, Array, int],
    leaves: list[tuple[Array, Array, Array]],
    reason: str = "",
) -> tuple[Proof, Supremum]:
    """Both answers, where ``best`` was met and ``leaves`` were closed, or left open where it is undecided."""
    lower, upper, bounds = _in_order(leaves)
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


def _at_rest(slacks: Sequence[float]) -> bool:
    """Whether what a tiny worst bound allows beyond the worst index that was met no longer falls with the size of the
    cells: then it is made of rounding."""
    return len(slacks) > 2 * REST and slacks[-1] <= TINY and slacks[-1] > ADVANCED * slacks[-1 - REST]


def _is_rounding(bound: float, bend: float, limit: float) -> bool:
    """Whether a tiny bound of a cell with one coordinate is above the ``limit`` by what does not fall with its width,
    the values at its ends with their rounding: no shorter one with that end is closed."""
    return bound <= TINY and bend <= FALLING * (bound - limit)


def _bounded(course: Course, x: Array, lower: Array, upper: Array) -> tuple[Array, Array, Array | None]:
    """Bounds ``(k,)`` of cells, the coordinates ``(k,)`` to halve, and what falls with the square of their widths
    ``(k,)``, where that is known; infinite for cells that there was no time for.

    In batches, so that memory does not grow with their number. Only where a deadline is set are batches as small as
    the time that they take asks for: what a cell costs is not known before, and a result that has no limit shall not
    depend on how fast the machine is. Cells that differ in their first coordinate only share their work (`enclose`),
    so that those go into one batch.
    """
    family, count = course.family, lower.shape[0]
    bounds, split, bend = np.full(count, np.inf), (upper - lower).argmax(axis=1), np.full(count, np.inf)
    known, hurried = True, course.deadline.bounded or course.deadline.passed
    start, size = 0, FIRST_BATCH if hurried else BATCH
    order, ends = _together(lower, upper) if count > size else (np.arange(count), np.array([count]))
    while start < count and not (start and course.deadline.passed):
        began, stop = time.perf_counter(), min(start + size, count)
        if hurried:  # to the end of what shares its work, unless that is far
            stop = min(int(ends[np.searchsorted(ends, stop)]), start + BATCH)
        part = order[start:stop]
        enclosed = family.enclosed(x, lower[part], upper[part])
        bounds[part] = enclosed.bounds
        split[part] = enclosed.split
        known = known and enclosed.bend is not None
        bend[part] = np.inf if enclosed.bend is None else enclosed.bend
        start, ended = stop, time.perf_counter()
        if course.deadline.bounded:
            size = min(BATCH, 2 * size) if ended - began < QUICK else max(1, size // 2)
        if start < count and ended - course.told > OFTEN:
            at = order[bounds[order[:start]].argmax()]
            course.tell(count, float(bounds[at]), lower[at], upper[at], start)
    return bounds, split, bend if known else None


def _together(lower: Array, upper: Array) -> tuple[np.ndarray, np.ndarray]:
    """An order ``(k,)`` of cells in which those that differ in their first coordinate only stand together, and where
    each such group ends; cells with no other coordinate in the order that they have, of which each may be an end."""
    count = lower.shape[0]
    if lower.shape[1] == 1:
        return np.arange(count), np.arange(1, count + 1)
    _, which = np.unique(np.hstack([lower[:, 1:], upper[:, 1:]]), axis=0, return_inverse=True)
    order = np.argsort(which.reshape(-1), kind="stable")
    return order, np.append(np.flatnonzero(np.diff(which.reshape(-1)[order])) + 1, count)


def _towards(peaks: Separation, lower: Array, upper: Array, bounds: Array, bend: Array) -> tuple[Array, Array] | None:
    """Cells ``(k, 1)``, those beside or around a peak cut at once into parts that are as short there as they must be
    and longer the farther they are from it, the others halved; ``None`` where no cell or too many would be cut so.

    From ``D`` to ``(1 + g) D`` beside a smooth peak of height ``v`` and curvature ``c`` the bound is about
    ``v - c D^2 / 2 + b (g D)^2 / 8``, with ``b`` the bound of the second derivative: so ``g = 2 sqrt(c / b)`` will do.
    """
    if not peaks.violations.size or lower.shape[0] > MOST_CUT:
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
            if inside > width / 8:  # the ends are below the peak by what its curvature makes of the distance
                curved = max(top - (bounds[i] - bend[i]), 0.0) / bend[i] * (width / inside) ** 2 / 4
                grow = float(np.clip(2 * SHARE * np.sqrt(curved), *GROWN))
            offsets = short * (1 + grow) ** np.arange(np.ceil(np.log(width / short) / np.log1p(grow)))
            cuts = np.concatenate([[low], at - offsets[::-1], at + offsets, [high]])
            cuts = np.concatenate([[low], cuts[(cuts > low) & (cuts < high)], [high]])
        if not (np.diff(cuts) > 0.0).all():
            return None
        starts.append(cuts[:-1])
        stops.append(cuts[1:])
    if all(one.size == 2 for one in starts):
        return None
    return np.concatenate(starts)[:, None], np.concatenate(stops)[:, None]


def _probe(family: ConstraintFamily, x: Array, lower: Array, upper: Array, bounds: Array) -> tuple[float, Array, int]:
    worst = np.argsort(-bounds, kind="stable")[:PROBED]
    centres = (lower[worst] + upper[worst]) / 2
    values = family.violations(x, centres)
    position, row = np.unravel_index(int(values.argmax()), values.shape)
    return float(values[position, row]), centres[position], int(row)


def _climb(family: ConstraintFamily, x: Array, lower: Array, upper: Array) -> tuple[float, Array, int]:
    """The largest violation that a climb from the middle of one cell finds, its index and row: steps along every axis
    and along all of them."""
    box, point, radius = family.index_set, (lower + upper) / 2, upper - lower
    best = (-np.inf, point, 0)
    for _ in range(MOVES):
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


def _in_order(leaves: list[tuple[Array, Array, Array]]) -> tuple[Array, Array, Array]:
    """All leaves, by their lower and then by their upper corners, and their bounds."""
    lower, upper, bounds = (np.concatenate(parts) for parts in zip(*leaves, strict=True))
    order = np.lexsort(np.hstack([lower, upper]).T[::-1])
    return lower[order], upper[order], bounds[order]


def _halved(lower: Array, upper: Array, split: Array) -> tuple[Array, Array] | None:
    """Both halves of every cell along its coordinate ``split``; ``None`` when a cell is too narrow to be halved in
    floating point."""
    rows = np.arange(split.size)
    middle = (lower[rows, split] + upper[rows, split]) / 2
    if ((middle <= lower[rows, split]) | (middle >= upper[rows, split])).any():
        return None
    left_upper, right_lower = upper.copy(), lower.copy()
    left_upper[rows, split] = middle
    right_lower[rows, split] = middle
    return np.vstack([lower, right_lower]), np.vstack([left_upper, upper])


def _by_separation(family: ConstraintFamily, x: Array) -> Proof:
    """For families without an enclosure: believe a proven bound of their separation, but for what both
    ends of the index set say, otherwise leave it open."""
    if family.worst is None:
        return Proof(
            family.name,
            "undecided",
            np.inf,
            reason=f"family {family.name} offers no enclosure, so nothing can be excluded",
        )
    found = family.separated(x)
    violation = float(found.violations[0]) if found.violations.size else -np.inf
    index, row = (found.indices[0], int(found.rows[0])) if found.violations.size else (None, 0)
    ends = np.stack([family.index_set.lower, family.index_set.upper])
    met = _probe(family, x, ends, ends, np.zeros(2)) if np.isfinite(ends).all() else (-np.inf, ends[0], 0)
    if met[0] > max(violation, TOLERANCE):  # what it says is believed, but not against its own rows
        violation, index, row = met
    if violation > TOLERANCE:
        return Proof(family.name, "refuted", np.inf, violation, index, row)
    if found.bound <= family.allowed(x):
        return Proof(family.name, "proven", found.bound, violation, index, row)
    return Proof(
        family.name,
        "undecided",
        found.bound,
        violation,
        index,
        row,
        reason=f"family {family.name} offers no enclosure, so nothing can be excluded",
    )


def _shown(point: Array) -> str:
    return np.array2string(point, precision=4, separator=", ", threshold=8)
