"""What rounding may do to a lower bound: subtracted before the bound is told, so that whoever derives it anew from its
multipliers never finds less."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sparserob_core.control.enclosures.decoupling import pace
from sparserob_core.control.enclosures.matrix_exponential import EPSILON
from sparserob_core.control.response.response import Weights
from sparserob_core.control.transcription.own_units import fixed
from sparserob_core.control.transcription.program import slanted
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.control.transcription.steps import Steps
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.inner.simplex.counterpart import robust_bound
from sparserob_core.sip.result import Result

SHARE = 64 * 2.0**-52  # of the numbers that are added up to a row: products of a few matrices and sums of many terms
INTEGRATED = 8.0  # as often do integrals of absolute values count: whoever encloses them adds up many parts of each
SMALL_GAP = 1e-11  # by which the gap may be wider then than it was to be
UNPROVEN = "nothing is feasible, but the signals that were found for the worst disturbances do not prove it"


def rounded_down(model: Transcription, result: Result, tolerance: float | None, prices: Array | None = None) -> Result:
    """The same result with a lower bound that rounding cannot have raised; no longer ``certified`` where that opens the
    gap beyond the relative ``tolerance``.

    A row ``c'x(t) <= b`` is a sum of what the initial state, every piece of the control and every piece of the
    disturbance bring to ``c'x(t)``. The absolute values of these, at their largest, times the multipliers of the rows
    and `SHARE`, bound what the rounding of all of them does to the bound (Higham 2002, section 3.1). A piece of the
    control whose push is below its price by more than that is 0 in the bound, whatever is rounded (`_pushed`). What a
    multiplier of the wrong sign may be off by is subtracted too (`_neglected`). Transitions are off by a share of their
    own (`_moving`), and by what a law leaves out of its series in the parameters (`_beyond`). With fewer functions than
    pieces multipliers of the pieces are off by rounding too (`_slipped`). Signals of measurable disturbances under
    feedback prove what they lead to, not what they were composed for (`_missed`); where they do not prove that nothing
    is feasible, that is not claimed. ``prices (n,)`` are those of the decision, where the bound is one of what its
    sizes cost at them.
    """
    if result.status == "infeasible" and np.subtract(*_missed(model, result)) >= 0.0:
        return replace(result, status="failed", message=UNPROVEN, infeasible=None, lower_bound=-np.inf)
    if not np.isfinite(result.lower_bound) or result.lower_bound <= 0.0:  # without multipliers 0 is exact
        return result
    share = SHARE + _moving(model)
    lost = share * (_added(model, result, share, prices) + _quadratic(model, result) + result.lower_bound)
    lost += _neglected(model, result) + _beyond(model, result) + _missed(model, result)[0] + _slipped(model, result)
    lowered = max(0.0, result.lower_bound - lost)
    dual = replace(result.dual, bound=min(result.dual.bound, lowered))
    answer = replace(result, lower_bound=lowered, dual=dual)
    if answer.status != "certified" or tolerance is None or answer.gap <= tolerance + SMALL_GAP:
        return answer
    message = f"the constraints are proven for the whole continuum; rounding leaves a gap of {answer.gap:.1e}"
    return replace(answer, status="verified", message=message)


def _moving(model: Transcription) -> float:
    """The share that transitions may be off by: of a system that changes with time, what their expansion leaves out;
    else a rounding for every time in which the system moves by its size, since those over a long time are squares of
    those over a short one (Moler and Van Loan 2003, method 3). Those of a known one are rounded once, but what rows go
    through after may cancel as much."""
    if model.response.system.varies:
        return model.response.propagator.slack
    middle = np.zeros(0) if model.parameters.set is None else model.parameters.set.interior_point()
    fastest = max(pace(mode.matrices(middle[None])[0][0]) for mode in model.response.system.modes)
    return EPSILON * fastest * model.problem.horizon


def _added(model: Transcription, result: Result, share: float, prices: Array | None) -> float:
    """The sum over all rows with a multiplier of multiplier times the numbers that are added up to the row, of which a
    ``share`` may be lost; ``prices`` as in `rounded_down`."""
    middle = model.parameters.middle
    rows, besides, whole = [], 0.0, prices is not None
    for cut, said in zip(result.dual.cuts, model.explained(result.dual.cuts), strict=True):
        constraint = model.constraint(model.program.family(cut.family))
        if said is not None and constraint is not None and cut.multiplier > 0.0:
            rows.append((cut.multiplier, said.time, said.direction, said.parameter_or(middle)))
            if said.gain is not None:
                besides += cut.multiplier * float(np.abs(said.gain) @ _far(model.problem.control))
            besides += cut.multiplier * float(constraint.reference.reach(said.direction))
            whole = whole and said.gain is None
        elif cut.multiplier > 0.0:
            whole = False
    for axis, price in zip(fixed(model.problem)[0], result.dual.mu, strict=False):
        rows.append((float(price), model.problem.horizon, axis, middle))
    if not rows:
        return 0.0
    multipliers, *indices = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    times, directions, parameters = indices[0], indices[1], indices[2].reshape(len(rows), -1)
    weights = model.response.weights(times, directions, parameters)
    sizes = np.abs(multipliers) @ _beside_control(model, weights, times, directions, parameters)
    prices = prices if whole and _plain(model, result) else None
    return float(sizes) + besides + _pushed(model, prices, weights.control, multipliers, share)


def _plain(model: Transcription, result: Result) -> bool:
    """Whether nothing but rows, the box of every entry of the decision and its price makes the bound."""
    finite, m = model.program.finite, model.problem.system.controls
    whole = finite.S is None and finite.P is None and finite.blocks is None and not finite.q.any()
    return whole and result.dual.z is None and finite.n == m * model.control.pieces


def _pushed(model: Transcription, prices: Array | None, weights: Array, multipliers: Array, share: float) -> float:
    """The numbers that are added up to what rows with ``multipliers (k,)``, of ``weights (k, L, m)``, make of the
    control, at its largest.

    The bound is the least of ``sum_j (w_j |u_j| + r_j u_j)`` over a box, ``w`` the ``prices`` and ``r`` the sum of the
    rows. Where it holds 0 it is attained at ``u_j = 0`` for every ``|r_j| <= w_j``: so only entries count whose
    ``|r_j|`` is not below ``w_j`` by more than a ``share`` of the largest numbers of any in their channel. All of them
    do where the bound is one of something else, and there are no prices.
    """
    sizes = np.tensordot(np.abs(multipliers), _controlled(model, weights), 1)
    if prices is not None:
        grid, finite = model.response.grid, model.program.finite
        functionals, m = model.functionals, model.problem.system.controls
        push = multipliers @ functionals.on_decision(weights)
        off = np.abs(multipliers) @ functionals.on_decision(np.abs(weights))
        off = np.repeat(off.reshape(m, -1).max(axis=1, initial=0.0), model.control.pieces)
        clear = (np.abs(push) + share * off < prices) & (finite.lower <= 0.0) & (finite.upper >= 0.0)
        sizes[clear.reshape(m, -1)[:, grid.control_piece[grid.decided]].T] = 0.0
    return float(sizes.sum())


def _beyond(model: Transcription, result: Result) -> float:
    """What a law leaves out of its series in the parameters, of all rows with a multiplier, at most."""
    off, lost = model.functionals.beyond(_far(model.problem.control)), 0.0
    if off.any():
        for cut, said in zip(result.dual.cuts, model.explained(result.dual.cuts), strict=True):
            lost += 0.0 if said is None else abs(cut.multiplier) * float(np.abs(said.direction[: off.size]) @ off)
    return lost


def _missed(model: Transcription, result: Result) -> tuple[float, float]:
    """By how much less the multipliers prove, at most, at the signals of measurable disturbances than at the deviations
    that these stand for: of every row multiplier times what its signal misses, times what that does to the row, gains
    at their largest; and what they prove at these deviations of the sum of the rows, without the cost. Without such
    disturbances, and where rows are samples, 0 and ``inf``.

    What is missed is not summed with its signs: whoever derives the bound counts gains in other ways.
    """
    loop, cuts, finite = None if model.feedback is None else model.feedback.loop, result.dual.cuts, model.program.finite
    whole = all(cut.formulation == "literal" for cut in cuts)
    if loop is None or loop.measurable is None or not cuts or not whole:
        return 0.0, np.inf
    model.explained(cuts)  # all signals are composed at once
    far, size, lost = np.maximum(np.abs(finite.lower), np.abs(finite.upper)), loop.measurable.size, 0.0
    blocks, multipliers, deviations = [], [], []
    for cut in cuts:
        index, w = np.split(cut.index, [cut.index.size - loop.spread.size])
        uncertain = model.program.family(cut.family).uncertain
        assert uncertain is not None
        rows = uncertain(index)
        blocks.append(rows)
        multipliers.append(np.where(np.arange(rows.h.size) == cut.row, cut.multiplier, 0.0))
        deviations.append(np.tile(w, (rows.h.size, 1)))
        part = int(rows.part[cut.row])
        off = cut.multiplier * abs(float(rows.factor[cut.row])) * np.abs(w[:size] - loop.measurable.attained(w[:size]))
        lost += float(off @ (np.abs(rows.d[part]) + abs(rows.C[part]) @ far)[:size])
    given = finite, blocks, np.concatenate(multipliers), np.vstack(deviations), result.dual.mu
    bound, added = robust_bound(*given, priced=False)
    return lost, bound - SHARE * added


def added_up(model: Transcription, times: Array, directions: Array, parameters: Array) -> Array:
    """The numbers ``(k,)`` that are added up to rows ``c'x(t)``, ``directions (k, d)``, at their largest."""
    weights = model.response.weights(times, directions, parameters)
    others = _beside_control(model, weights, times, directions, parameters)
    return np.asarray(others + _controlled(model, weights.control).sum(axis=(1, 2)))


def _controlled(model: Transcription, weights: Array) -> Array:
    """Those ``(k, J, m)`` that every piece of the control brings, by ``weights (k, L, m)``."""
    return np.asarray(np.abs(model.functionals.decided(weights)) * _far(model.problem.control))


def _beside_control(
    model: Transcription, weights: Weights, times: Array, directions: Array, parameters: Array
) -> Array:
    """Those ``(k,)`` beside what the control brings."""
    functionals, free = model.functionals, np.abs(weights.free)
    sizes = free @ np.abs(model.response.initial_state)
    if model.problem.initial_set is not None:
        sizes += free @ _far(model.problem.initial_set)
    sizes += np.einsum("klm,ml->k", np.abs(weights.control), np.abs(functionals.known))
    if functionals.execution is not None:
        lengths = functionals.execution.lengths(times, functionals.execution.seen(directions, parameters))
        sizes += INTEGRATED * (lengths @ np.repeat(_far(model.problem.control), model.control.pieces))
    return np.asarray(sizes + _disturbing(model, weights.disturbance, times, directions, parameters))


def _disturbing(model: Transcription, on_noise: Array, times: Array, directions: Array, parameters: Array) -> Array:
    """The numbers ``(k,)`` that are added up to what disturbances do, from the weights ``on_noise (k, L, mw)``."""
    if model.problem.disturbance is None:
        return np.zeros(times.size)
    sizes: Array = (np.abs(on_noise) @ _far(model.problem.disturbance)).sum(axis=1)
    measurable = model.functionals.measurable
    if measurable is None:
        return sizes
    return sizes + INTEGRATED * measurable.integrated_sizes(times, directions, parameters)


def _quadratic(model: Transcription, result: Result) -> float:
    """The numbers that are added up to the tangent of the quadratic terms, at its largest: where the slope ``P at`` is
    small because they cancel, as along a flat direction of ``P``, their rounding is not."""
    finite, at = model.program.finite, result.dual.at
    if finite.P is None or at is None:
        return 0.0
    far = _coefficients(model)
    bent, at, q = (np.abs(model.nominal(each)) for each in (np.asarray(abs(finite.P) @ np.abs(at)), at, finite.q))
    return float(abs(finite.constant) + 0.5 * at @ bent + (q + bent) @ far)


def _coefficients(model: Transcription) -> Array:
    """How far the coefficients of the control come from 0, ``(m N,)``."""
    reach = model.problem.control.reach(np.eye(model.problem.system.controls))
    if model.program.finite.S is None:
        return np.repeat(reach, model.control.pieces)
    return np.asarray(np.kron(reach, np.abs(np.linalg.pinv(model.control.values.T)).sum(axis=1)))


def _slipped(model: Transcription, result: Result) -> float:
    """What multipliers of the image may be off the slopes that they stand for, times the largest coefficients: the
    rounding of each sum that makes one of the other (Higham 2002, section 3.1)."""
    S, z = model.program.finite.S, result.dual.z
    if S is None or z is None:
        return 0.0
    terms = int(np.diff(S.tocsc().indptr).max(initial=0))
    sizes = model.nominal(np.asarray(abs(S).T @ np.abs(z)))
    return float((terms + 8) * EPSILON * np.abs(sizes) @ _coefficients(model))


def _neglected(model: Transcription, result: Result) -> float:
    """What multipliers of the wrong sign cost on slanted sides ``H u <= h`` of the controls' set, and of that of their
    steps, at most, with the rounding of what is added up to them.

    To the program ``s = H u`` has no lower bound, so that only ``z >= 0`` proves anything of ``-z s``; a negative ``z``
    within its own rounding counts as 0 there. On the set ``-z s`` is at least ``z`` times the largest ``-H u``.
    """
    if result.dual.z is None:
        return 0.0
    (H, h), bound = slanted(model.problem.control), model.problem.control
    controls, pieces = model.problem.system.controls, model.control.pieces
    sides, others = np.split(result.dual.z[controls * pieces :], [h.size * pieces])
    lost = float(np.maximum(-sides, 0.0).reshape(h.size, pieces).sum(axis=1) @ np.maximum(bound.support(-H), 0.0))
    # of opposite sides of a set without interior multipliers may be as large as they like
    lost += SHARE * float(np.abs(sides).reshape(h.size, pieces).sum(axis=1) @ (np.abs(H) @ _far(bound)))
    steps = Steps.of(model.problem, model.control)
    if steps.count:
        own = others[: steps.upper.size * steps.times.size]  # what follows bounds sizes from both sides
        table, far = own.reshape(steps.upper.size, steps.times.size), 2.0 * np.abs(steps.H) @ _far(bound)
        wrong = np.where(np.isfinite(steps.upper), 0.0, np.maximum(table, 0.0).sum(axis=1))
        wrong += np.where(np.isfinite(steps.lower), 0.0, np.maximum(-table, 0.0).sum(axis=1))
        lost += float((wrong + SHARE * np.abs(table).sum(axis=1)) @ far)
    return lost


def _far(convex: ConvexSet) -> Array:
    """How far each component of a bounded set comes from 0, ``(d,)``."""
    axes = np.eye(convex.dimension)
    return np.maximum(np.abs(convex.support(axes)), np.abs(convex.support(-axes)))
