"""Branch and bound over which entries count: a tree of convex programs, every leaf with multipliers that prove it.

The simplex method, or the solver that was named, only says where to look. What is claimed of a leaf is weak duality
with its multipliers, or Farkas' lemma, evaluated by `inner.duality`; whoever doubts the tree follows it with the
multipliers alone (`checker`).
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.sparse import csr_array, diags_array, eye_array, hstack, kron

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.evidence import NO_BOUND, Branch, Dual, Leaf
from sparserob_core.sip.finite import HIGHS, NOBODY, FiniteProgram
from sparserob_core.sip.inner.duality import bound_with_multipliers, farkas_proof
from sparserob_core.sip.inner.simplex.interruptible import solve_with_integers
from sparserob_core.sip.inner.solve import elastic_program, interpret_elastic_answer
from sparserob_core.sip.inner.vertex import Corner, simplex
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram, Rows
from sparserob_core.sip.working.counting import MISSED, convex_below, prices_of, round_up_count, vectors

MIXED_INTEGER_SECONDS = 20.0  # that a mixed-integer program may take
INTEGRAL = 1e-6  # of an entry's range, within which it is 0 or a letter
IMPOSSIBLE = 1e-9  # of the numbers that cancel in it, what a proof of infeasibility must exceed
PART_BOUND_ALLOWANCE = 1e-9  # of a bound, so that whoever derives it with another rounding does not find less


@dataclass(frozen=True, eq=False)
class BranchNode:
    """Subset of the decisions, a node of the tree: one change of the bounds of an image in the part ``above`` it.

    Either the image has the bounds ``lower`` and ``upper``, or it counts (``on``). All images that count together with
    it are 0, or count, with it. In this part the count is at least ``bound``, and ``x (n,)`` is the point to examine
    next.
    """

    above: int
    image: int
    lower: float
    upper: float
    on: bool
    bound: float = -np.inf
    x: Array | None = None


@dataclass(eq=False)
class Branching:
    """A tree over ``program`` with the rows ``rows``. ``letters``: for an alphabet, its values in the program's units
    ``(k, letters)``, ascending; ``alphabet``: the same as the user writes them."""

    program: SemiInfiniteProgram
    relaxed: RelaxedProgram
    rows: Rows
    letters: Array | None = None
    alphabet: Sequence[float] = ()
    parts: list[BranchNode] = field(default_factory=list)
    nodes: list[Leaf | Branch] = field(default_factory=list)
    _heap: list[tuple[float, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        base = self.program.finite
        self.prices, self._vector_numbers = prices_of(self.program), vectors(self.program)
        root = BranchNode(-1, 0, float(base.lower[0]), float(base.upper[0]), False)
        self.parts, self.nodes = [root], [Leaf(NO_BOUND)]
        self._heap = [(self._update_bound(0), 0)]

    @property
    def lower(self) -> float:
        """Lower bound of the count of every decision, in the user's units; infinite where nothing is feasible."""
        return min((self._round_bound(bound) for bound, _ in self._heap), default=np.inf)

    def _round_bound(self, bound: float) -> float:
        return bound if np.isinf(bound) else round_up_count(self.program, bound - PART_BOUND_ALLOWANCE * abs(bound))

    def open(self, incumbent: float) -> bool:
        """Return whether a part may contain a decision that counts less than the ``incumbent``."""
        least = self._heap[0][0] if self._heap else np.inf
        return least < np.inf and self._round_bound(least) < incumbent * (1.0 - MISSED)

    def grow(self, incumbent: Callable[[], float], look: Callable[[Array], bool]) -> bool:
        """Divide the part with the least bound, of a tree that is open; ``False`` where it cannot be divided. ``look``
        is shown decisions that count less, and returns whether the rows or the ``incumbent`` count are others now: then
        the part is bounded anew instead."""
        bound, number = self._heap[0]
        x = self.parts[number].x
        if x is None:
            return False
        image = self._find_undecided(number, x)
        if image is None and look(x):
            if self._round_bound(bound) < incumbent() * (1.0 - MISSED):
                heapq.heapreplace(self._heap, (self._update_bound(number), number))
            return True
        if image is None and (image := self._find_free(number)) is None:
            return False
        self._divide(number, image, float(self.program.finite.image(x)[image]))
        return True

    def _divide(self, number: int, image: int, value: float) -> None:
        low, high, _ = self._find_bounds(self.parts[number])
        below, above = float(low[image]), float(high[image])
        if self.letters is None:
            letters_at_cut = None
            children = [BranchNode(number, image, 0.0, 0.0, False), BranchNode(number, image, below, above, True)]
        else:
            allowed = self.letters[image]
            indices = np.flatnonzero((allowed >= below) & (allowed <= above))
            cut = int(np.clip(np.searchsorted(allowed[indices], value, side="right"), 1, indices.size - 1))
            lower_index, upper_index = int(indices[cut - 1]), int(indices[cut])
            letters_at_cut = (float(self.alphabet[lower_index]), float(self.alphabet[upper_index]))
            children = [
                BranchNode(number, image, below, float(allowed[lower_index]), False),
                BranchNode(number, image, float(allowed[upper_index]), above, False),
            ]
        # measured before anything is changed: whoever is interrupted leaves a tree that covers every decision
        bounded_children, first = [self._bound_part(child, Leaf(NO_BOUND)) for child in children], len(self.nodes)
        heap = [entry for entry in self._heap if entry[1] != number]
        heap += [(child.bound, first + k) for k, (child, _) in enumerate(bounded_children)]
        heapq.heapify(heap)
        self.parts += [child for child, _ in bounded_children]
        self.nodes += [leaf for _, leaf in bounded_children]
        self.nodes[number], self._heap = Branch(image, first, first + 1, letters_at_cut), heap
        self.parts[number] = replace(self.parts[number], x=None)

    def _update_bound(self, number: int) -> float:
        """Bound one part anew; the bound that is known of it now."""
        leaf = self.nodes[number]
        assert isinstance(leaf, Leaf)
        self.parts[number], self.nodes[number] = self._bound_part(self.parts[number], leaf)
        return self.parts[number].bound

    def _bound_part(self, part: BranchNode, leaf: Leaf) -> tuple[BranchNode, Leaf]:
        """A part and its leaf, bounded with all rows; with what was known of it where that is better."""
        finite, certain = self._build_finite(part)
        corner = self._solve_part(finite)
        y, mu, z = corner.y, corner.mu, corner.z
        fallback = replace(part, bound=max(part.bound, 0.0))
        if corner.status == "infeasible":
            amount = farkas_proof(finite, y, mu, z, IMPOSSIBLE)
            if amount is None:
                return fallback, leaf
            size = float(y @ np.linalg.norm(finite.G, axis=1) + np.abs(mu) @ np.linalg.norm(finite.A, axis=1))
            z = None if z is None else z / size
            dual = self._make_dual(finite, y / size, mu / size, z, amount, False)
            return replace(part, bound=np.inf, x=None), Leaf(dual, feasible=False)
        if corner.status != "optimal":
            return fallback, leaf
        candidates = [(y, mu, z), (np.zeros_like(y), np.zeros_like(mu), None)]
        bounds = [bound_with_multipliers(finite, *candidate) for candidate in candidates]
        bound, y, mu, z = max(bounds, key=lambda item: item[0])
        bound += certain - self.relaxed.rounding(finite, y, mu, corner.x)
        if bound > part.bound:
            leaf = Leaf(self._make_dual(finite, y, mu, z, bound))
        return replace(part, bound=max(bound, part.bound), x=corner.x), leaf

    def _solve_part(self, finite: FiniteProgram) -> Corner:
        """The answer to the linear program of a part, with multipliers that may prove it infeasible where it is said to
        be: of the solver that was named, or of the simplex method, whose vertices have zeros."""
        if self.relaxed.counted.instead is not None:
            answer = self.relaxed.answered(finite)
            return Corner(answer.status, answer.x, answer.y, answer.mu, None if finite.S is None else answer.z)
        corner = simplex(finite)
        self.relaxed.count(HIGHS if corner.status in ("optimal", "infeasible") else NOBODY)
        return _find_infeasibility(finite) if corner.status == "infeasible" else corner

    def _make_dual(
        self, finite: FiniteProgram, y: Array, mu: Array, z: Array | None, bound: float, priced: bool = True
    ) -> Dual:
        """Multipliers of the ``finite`` program of a part in the unit of the cost, as every program tells them. The
        linear cost of a part is not that of the whole program: ``z`` is made to meet its own."""
        unit, z = self.program.cost_unit, np.zeros(self.program.finite.weights.size) if z is None else z
        of = replace(finite, q=finite.q / unit, weights=finite.weights / unit)
        return self.relaxed.dual(self.rows, y / unit, mu / unit, z / unit, bound / unit, priced=priced, of=of)

    def _find_bounds(self, part: BranchNode) -> tuple[Array, Array, np.ndarray]:
        """The bounds of all images in one part, and which count there whatever their value."""
        base = self.program.finite
        lower, upper, is_on = base.lower.copy(), base.upper.copy(), np.zeros(base.lower.size, dtype=bool)
        assigned_images: set[int] = set()
        while part.above >= 0:
            if part.image not in assigned_images:
                lower[part.image], upper[part.image], is_on[part.image] = part.lower, part.upper, part.on
                assigned_images.add(part.image)
                for image in np.flatnonzero(self._vector_numbers == self._vector_numbers[part.image]).tolist():
                    if (
                        image not in assigned_images
                    ):  # nothing else was said of it, so that its bounds are those of the program
                        lower[image], upper[image] = (lower[image], upper[image]) if part.on else (0.0, 0.0)
                        is_on[image] = part.on
                        assigned_images.add(image)
            part = self.parts[part.above]
        return lower, upper, is_on

    def _build_finite(self, part: BranchNode) -> tuple[FiniteProgram, float]:
        lower, upper, is_on = self._find_bounds(part)
        base = replace(self.relaxed.finite(self.rows.G, self.rows.h, 0.0), lower=lower, upper=upper)
        finite, _, certain = convex_below(base, self.prices, is_on)
        return finite, certain

    def _find_undecided(self, number: int, x: Array) -> int | None:
        """The image that is furthest from being decided at ``x``; ``None`` where each is 0, on, or a letter."""
        lower, upper, is_on = self._find_bounds(self.parts[number])
        image = self.program.finite.image(x)
        is_counted = self.prices > 0.0
        if self.letters is not None:
            distances = np.abs(image[: len(self.letters), None] - self.letters).min(axis=1)
            radii = np.maximum(np.abs(lower), np.abs(upper))[: distances.size]
            share = np.where(is_counted[: distances.size], distances / np.where(radii > 0.0, radii, 1.0), 0.0)
        else:
            with np.errstate(divide="ignore", invalid="ignore"):
                fraction = np.where(image > 0.0, image / upper, image / lower)
            fraction = np.where(is_counted & ~is_on & (lower <= 0.0) & (upper >= 0.0) & (image != 0.0), fraction, 0.0)
            share = np.minimum(fraction, 1.0 - fraction)
        choice = int(np.argmax(share))
        return choice if share[choice] > INTEGRAL else None

    def _find_free(self, number: int) -> int | None:
        """An image that may still be 0 or not, or one of several letters."""
        lower, upper, is_on = self._find_bounds(self.parts[number])
        is_free = (self.prices > 0.0) & ~is_on & (lower < upper)
        if self.letters is None:
            is_free &= (lower <= 0.0) & (upper >= 0.0)
        return int(np.argmax(is_free)) if is_free.any() else None


def _find_infeasibility(program: FiniteProgram) -> Corner:
    """Multipliers that may prove that a finite program is infeasible: those of its elastic program."""
    corner = simplex(elastic_program(program))
    if corner.status != "optimal":
        return Corner("infeasible", np.zeros(program.n), np.zeros(program.h.size), np.zeros(program.b.size))
    return Corner("infeasible", *interpret_elastic_answer(program, (corner.x, corner.y, corner.mu, corner.z)))


def propose_decision(
    program: SemiInfiniteProgram, relaxed: RelaxedProgram, rows: Rows, letters: Array | None, gap: float = 0.0
) -> Array | None:
    """Return a decision ``(n,)`` with the fewest counted entries among all that satisfy the ``rows``, as HiGHS finds
    it.

    The optimality gap of the mixed-integer program is relative. Nothing of the answer is believed.

    Parameters
    ----------
    program : SemiInfiniteProgram
        The program whose entries are counted.
    relaxed : RelaxedProgram
        Maker of the finite program, with the deadline.
    rows : Rows
        Constraints that the decision must satisfy.
    letters : array, (k, letters), or None
        Allowed values of each entry; ``None``: an entry may be 0 or between its bounds.
    gap : float
        Relative gap at which HiGHS may stop.

    Returns
    -------
    array, (n,), or None
        The decision; ``None`` where HiGHS finds none in time.
    """
    from scipy.optimize import LinearConstraint

    finite, prices = relaxed.finite(rows.G, rows.h, 0.0), prices_of(program)
    n, unit = program.n, prices[prices > 0.0].min()
    S = csr_array(eye_array(n)) if finite.S is None else csr_array(finite.S)
    groups = vectors(program)
    blocks = _couple_binaries(S, finite, prices, groups) if letters is None else _couple_letters(S, letters, prices)
    cost, couplings = blocks[0] / unit, list(blocks[1])
    count, seconds_left = cost.size, relaxed.deadline.left
    linear_rows = [(S, finite.lower, finite.upper), (finite.G, -np.inf, finite.h), (finite.A, finite.b, finite.b)]
    couplings += [
        LinearConstraint(hstack([csr_array(matrix), csr_array((matrix.shape[0], count))], format="csr"), low, high)
        for matrix, low, high in linear_rows
        if matrix.shape[0]
    ]
    bounds = np.repeat([-np.inf, 0.0], [n, count]), np.repeat([np.inf, 1.0], [n, count])
    seconds = MIXED_INTEGER_SECONDS if seconds_left is None else min(MIXED_INTEGER_SECONDS, seconds_left)
    solution = solve_with_integers(np.concatenate([np.zeros(n), cost]), couplings, *bounds, n, seconds, gap)
    return None if solution is None else solution[:n]


def _couple_binaries(S: Any, finite: FiniteProgram, prices: Array, together: np.ndarray) -> tuple[Array, list[Any]]:
    """``lower b <= s <= upper b`` with ``b`` 0 or 1, the same for all that count ``together (k,)``, and what every
    ``b`` costs."""
    from scipy.optimize import LinearConstraint

    optional = np.flatnonzero((prices > 0.0) & (finite.lower <= 0.0) & (finite.upper >= 0.0))
    above, below = (diags_array(-side[optional]) for side in (finite.upper, finite.lower))
    couplings = [
        LinearConstraint(hstack([S[optional], above], format="csr"), -np.inf, 0.0),
        LinearConstraint(hstack([S[optional], below], format="csr"), 0.0, np.inf),
    ]
    _, firsts, groups = np.unique(together[optional], return_index=True, return_inverse=True)
    followers = np.flatnonzero(firsts[groups] != np.arange(optional.size))
    if followers.size:
        rows = np.arange(followers.size)
        columns = np.concatenate([followers, firsts[groups[followers]]]) + S.shape[1]
        values = np.repeat([1.0, -1.0], followers.size)
        equalities = csr_array(
            (values, (np.tile(rows, 2), columns)), shape=(followers.size, S.shape[1] + optional.size)
        )
        couplings.append(LinearConstraint(equalities, 0.0, 0.0))
    return prices[optional], couplings


def _couple_letters(S: Any, letters: Array, prices: Array) -> tuple[Array, list[Any]]:
    """``s = sum_j letters_j b_j`` with one ``b_j`` of each entry 1, and what every ``b`` costs."""
    from scipy.optimize import LinearConstraint

    size, width = letters.shape
    positions = (np.repeat(np.arange(size), width), np.arange(size * width))
    combinations = csr_array((letters.ravel(), positions), shape=(size, size * width))
    sums = csr_array(kron(eye_array(size), np.ones((1, width))))
    return (prices[:size, None] * (letters != 0.0)).ravel(), [
        LinearConstraint(hstack([S[:size], -combinations], format="csr"), 0.0, 0.0),
        LinearConstraint(hstack([csr_array((size, S.shape[1])), sums], format="csr"), 1.0, 1.0),
    ]
