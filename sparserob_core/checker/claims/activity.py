"""A lower bound, in ball arithmetic, of the share of time that an admissible control must act.

An entry ``u_i`` of a control with values in ``[low_i, high_i]`` satisfies
``max(u_i, 0) / high_i + max(-u_i, 0) / |low_i| <= [u_i != 0]``. Where 0 is outside of the interval, the entry counts
always. So the minimum of that cost over the admissible controls is at most the weighted time that any of them acts.
Weak duality bounds the minimum from below."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from flint import arb

from sparserob_core.checker.arithmetic.balls import ball, smallest
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.cost.duality import ConstraintRow
from sparserob_core.checker.outcome import Broken
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.shape import find_range
from sparserob_core.control.sets.curved import NormBall

ROUNDED = 1e-12  # relative to the terms of a value of the control: a smaller value counts as 0
EQUAL = 1e-12  # counts that differ by no more are equal
NEARLY = 1e-6  # relative to one count: a bound that is above a whole number of counts by less is rounded down to it

Rows = list[tuple[float, ConstraintRow]]


def active_share(case: Case) -> float:
    """Return the share of time, weighted over the channels, that the certificate's control acts."""
    is_active = np.abs(case.control.control(case.theta)) > ROUNDED * case.control.summands(case.theta)
    for block in case.price.blocks:  # the channels of one vector act together
        is_active[block] = is_active[block].any(axis=0)
    counts = _compute_counts(case)
    return float(counts[is_active].sum() / counts.sum())


def convert_multipliers(case: Case, rows: Rows, pieces: Any) -> tuple[Rows, Any]:
    """Return multipliers of the cost as multipliers of the count, with those of the pieces, ``(m, K)`` or ``None``. Any
    positive divisor is valid; best is the largest absolute value of a channel times the factor ``l1`` of the cost."""
    divisor = max(
        (max(float(abs(low).mid()), float(abs(high).mid())) for low, high in _enclose_ranges(case)), default=1.0
    )
    divisor = divisor * case.problem.cost.l1 or 1.0
    piece_multipliers = pieces if pieces is None else (np.asarray(pieces, dtype=float) / divisor).tolist()
    return [(y / divisor, row) for y, row in rows], piece_multipliers


def bound_by_multipliers(case: Case, rows: Rows, pieces: Sequence[Sequence[float]] | None) -> float:
    """Return the share of time, from 0 to 1, that every admissible control acts at least: a whole number of pieces
    where all count the same. ``rows`` are multipliers with their constraints, ``pieces (m, K)`` those of the control's
    pieces."""
    total, slopes = case.duality.summed(rows, pieces)
    ranges = _enclose_ranges(case)
    counts = [[ball(c) * length for c in case.price.counts] for length in _enclose_lengths(case)]
    none = [[ball(0)] * case.problem.system.controls] * len(slopes)
    charged = case.duality.charged(rows, none)
    for count, slope, sizes in zip(counts, slopes, charged, strict=True):
        case.clock.check()
        total = total + _bound_piece(case, ranges, count, slope, sizes=sizes)
    return _bound_active_share(case, total)


def bound_by_cost(case: Case, cost: arb) -> float:
    """Return the share of time that every admissible control acts at least, where none costs less than ``cost``. A
    vector of channels that is not 0 costs at most its highest weight times the largest length that it can have."""
    counts, highest = case.price.counts, case.price.highest
    factors = [
        ball(len(block)) * ball(counts[c]) / (ball(case.problem.cost.l1) * ball(highest[c]) * longest)
        for block in case.price.blocks
        if (longest := _bound_length(case, block)) > 0 and highest[c := block[0]] > 0.0
    ]
    if not factors:
        return 0.0
    return _bound_active_share(case, cost * smallest(factors))


def _bound_length(case: Case, block: Sequence[int]) -> arb:
    """Return an upper bound of the Euclidean length of the vector of some channels."""
    bound, ranges = case.problem.control, _enclose_ranges(case)
    largest_values = [abs(ranges[i][0]).max(abs(ranges[i][1])) for i in block]
    size = sum((r * r for r in largest_values), ball(0)).sqrt()
    if isinstance(bound, NormBall) and bound.p == 2.0:
        middle = sum((ball(bound.centre[i]) ** 2 for i in block), ball(0)).sqrt()
        size = size.min(ball(bound.radius) + middle)
    return size


def _bound_active_share(case: Case, total: arb) -> float:
    """Return a lower bound of the time of action as a share of the largest."""
    return min(1.0, _bound_active_time(case, total) / float(_sum_counts(case).sum()))


def _bound_active_time(case: Case, total: arb) -> float:
    """Return a lower bound of the time of action, rounded up to whole pieces where all of them count the same."""
    counts = _sum_counts(case)
    bound = float(np.nextafter(float(total.lower()), -np.inf))
    if np.ptp(counts) <= EQUAL * counts.max():
        count = float(counts.mean())
        bound = float(np.ceil(bound / count - NEARLY)) * count
    return max(0.0, bound)


def _bound_piece(
    case: Case,
    ranges: list[tuple[arb, arb]],
    count: list[arb],
    slope: list[arb],
    off: Sequence[bool] = (),
    sizes: Sequence[arb] = (),
) -> arb:
    """Return a lower bound over the set of the count of the channels that act on one piece, plus ``slope (m,)`` times
    the control, plus ``sizes (m,)`` times its absolute values. The channels marked in ``off`` are 0."""
    ups, downs, certain = [], [], ball(0)
    for (low, high), count_i in zip(ranges, count, strict=True):
        excludes_zero = low > 0 or high < 0
        certain = certain + (count_i if excludes_zero else ball(0))
        up = ball(0) if excludes_zero or not high > 0 else count_i / high
        down = ball(0) if excludes_zero or not low < 0 else count_i / -low
        ups.append(up if high > 0 else down)
        downs.append(down if low < 0 else up)
    for i, size in enumerate(sizes):
        ups[i], downs[i] = ups[i] + size, downs[i] + size
    for i, is_zero in enumerate(off):
        if is_zero:  # then no value other than 0 lowers the sum
            ups[i] = downs[i] = abs(slope[i])
    return certain + known(case.problem.control).least(ups, downs, slope)


def _enclose_ranges(case: Case) -> list[tuple[arb, arb]]:
    """Return the least and the largest value of every channel."""
    return [find_range(known(case.problem.control), i) for i in range(case.problem.system.controls)]


def _enclose_lengths(case: Case) -> list[arb]:
    """Return the length of every piece of the control, in time."""
    breakpoints = case.control.breakpoints
    return [ball(b) - ball(a) for a, b in pairwise(breakpoints)]


def _compute_counts(case: Case) -> np.ndarray:
    """Return the count of every piece of every channel, ``(m, K)``: its weight times its length."""
    return np.asarray(np.outer(case.price.counts, np.diff(case.control.breakpoints)))


def _sum_counts(case: Case) -> np.ndarray:
    """Return the count of every piece of every vector of channels, ``(b, K)``."""
    counts = _compute_counts(case)
    return np.array([counts[block].sum(axis=0) for block in case.price.blocks])


def longest_time(case: Case) -> float:
    """Return the longest time that a control can act, weighted over its channels."""
    return float(_compute_counts(case).sum())


Part = tuple[float, float, bool]
"""The lower and upper bound of one piece of one channel in a part, and whether it counts whatever its value."""
ANY: Part = (-np.inf, np.inf, False)


def bound_by_tree(case: Case, nodes: Sequence[Any], weighted: Callable[[Mapping[str, Any]], Rows]) -> float:
    """Return a lower bound of the time that every control acts, by the leaves of a tree of parts of the controls, the
    root first; infinite where every leaf proves that its part holds no feasible control. ``weighted`` returns the
    multipliers of a leaf with their constraints. Raise `Broken` where the nodes are no tree whose leaves cover all
    controls."""
    bound, open_nodes, visited = float("inf"), [(0, dict[tuple[int, int], Part]())], set[int]()
    while open_nodes:
        case.clock.check()
        number, restrictions = open_nodes.pop()
        node = nodes[number] if 0 <= number < len(nodes) else None
        if number in visited or not isinstance(node, Mapping):
            raise Broken("tree: its nodes are no tree")
        visited.add(number)
        if "multipliers" in node:
            bound = min(bound, _bound_leaf(case, node.get("feasible") is not False, restrictions, weighted(node)))
            continue
        halves = _divide_part(case, node, restrictions)
        for key, half in zip(("first", "second"), halves, strict=True):
            child = node.get(key)
            if type(child) is not int:
                raise Broken("tree: expected the numbers of two nodes")
            open_nodes.append((child, {**restrictions, **half}))
    return bound


def _divide_part(
    case: Case, node: Mapping[str, Any], parts: Mapping[tuple[int, int], Part]
) -> tuple[dict[tuple[int, int], Part], dict[tuple[int, int], Part]]:
    """Return two halves that together hold every control of a part: between two letters of an alphabet, or else the
    vector of the channel at 0 on the piece, and counted whatever its value."""
    channel, piece = node.get("channel"), node.get("piece")
    m, K = case.problem.system.controls, case.control.pieces
    if type(channel) is not int or type(piece) is not int or not (0 <= channel < m and 0 <= piece < K):
        raise Broken(f"tree: there is no piece {piece!r} of channel {channel!r}")
    if case.letters is None:
        (block,) = (block for block in case.price.blocks if channel in block)
        block_ranges = {(c, piece): parts.get((c, piece), ANY) for c in block}
        return dict.fromkeys(block_ranges, (0.0, 0.0, False)), {
            key: (low, high, True) for key, (low, high, _) in block_ranges.items()
        }
    low, high, is_counted = parts.get((channel, piece), ANY)
    letters = node.get("at")
    if not (
        isinstance(letters, list)
        and len(letters) == 2
        and all(value in case.letters for value in letters)
        and letters[0] < letters[1]
    ):
        raise Broken(f"tree: expected two letters, got {letters!r}")
    if any(letters[0] < letter < letters[1] for letter in case.letters):
        raise Broken(f"tree: {letters} are no neighbours")
    key = channel, piece
    return {key: (low, min(high, float(letters[0])), is_counted)}, {
        key: (max(low, float(letters[1])), high, is_counted)
    }


def _bound_leaf(case: Case, feasible: bool, parts: Mapping[tuple[int, int], Part], rows: Rows) -> float:
    """Return a lower bound of the time that the controls of one part act; infinite where none is feasible."""
    total, slopes = case.duality.summed(rows, None)
    sizes = case.duality.charged(rows, [[ball(0)] * case.problem.system.controls] * len(slopes))
    for k, (length, slope, charged) in enumerate(zip(_enclose_lengths(case), slopes, sizes, strict=True)):
        piece_restrictions = [parts.get((c, k), ANY) for c in range(len(slope))]
        counts = [ball(c) * length if feasible else ball(0) for c in case.price.counts]
        total = total + _bound_piece_in_part(case, piece_restrictions, counts, slope, charged)
    if not feasible:
        if not total > 0:
            raise Broken(f"tree: multipliers of a part prove {float(total.lower()):.3g}, expected a positive number")
        return float("inf")
    return _bound_active_time(case, total)


def _bound_piece_in_part(
    case: Case, parts: Sequence[Part], counts: list[arb], slope: list[arb], sizes: Sequence[arb]
) -> arb:
    """Return a lower bound of the sum that one piece contributes, as `_bound_piece` does, over a part's controls."""
    if case.problem.control.is_box or case.letters is not None:
        box, total = case.problem.control.bounding_box(), arb(0)
        for part, count, s, size, low, high in zip(parts, counts, slope, sizes, box.lower, box.upper, strict=True):
            values = _list_candidate_values(case, part, float(low), float(high))
            if not values:
                return arb("inf")  # nothing is in this part
            sums = [(count if part[2] or v != 0.0 else arb(0)) + s * arb(v) + size * arb(abs(v)) for v in values]
            total = total + smallest(sums)
        return total
    certain = sum((count for part, count in zip(parts, counts, strict=True) if part[2]), arb(0))
    priced = [arb(0) if part[2] else count for part, count in zip(parts, counts, strict=True)]
    return certain + _bound_piece(
        case, _enclose_ranges(case), priced, slope, [part[:2] == (0.0, 0.0) for part in parts], sizes
    )


def _list_candidate_values(case: Case, part: Part, low: float, high: float) -> list[float]:
    """Return the values among which the count of an entry plus any slope has its minimum. The values are the ends of
    the range of the entry, and 0 in between; with an alphabet, the letters in the range."""
    if case.letters is not None:
        return [letter for letter in case.letters if part[0] <= letter <= part[1]]
    lower, upper = max(low, part[0]), min(high, part[1])
    return [] if lower > upper else [lower, upper, float(np.clip(0.0, lower, upper))]
