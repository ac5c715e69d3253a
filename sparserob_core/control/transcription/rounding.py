"""Effect of rounding on a lower bound.

An allowance for this effect is subtracted before the bound is reported. A later derivation of the bound from its
multipliers is then not to find a smaller one. The allowance is a fixed `ROW_ROUNDING` of the numbers that are added up.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sparserob_core.control.enclosures.decoupling import pace
from sparserob_core.control.response.inner_loop import Weights
from sparserob_core.control.transcription.own_units import extent, fixed
from sparserob_core.control.transcription.program import slanted_sides
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.control.transcription.steps import Steps
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.rounding import EPSILON
from sparserob_core.sip.result import Result

# Of the numbers that are added up to a row: products of a few matrices and sums of many terms
ROW_ROUNDING = 64 * 2.0**-52
INTEGRATED = 8.0  # weight of integrals of absolute values: enclosures of them add up many parts of each
SMALL_GAP = 1e-11  # excess of the gap over its tolerance, after the reduction, that leaves a result certified


def reduce_bound(model: Transcription, result: Result, tolerance: float | None, prices: Array | None = None) -> Result:
    """Return the same result with its lower bound reduced by an allowance for rounding. The result is no longer
    ``certified`` where this opens the gap beyond the relative ``tolerance``. A bound of at most 0 is left as it is.

    A row ``c'x(t) <= b`` is a sum of the contributions of the initial state, every piece of the control and every piece
    of the disturbance to ``c'x(t)``. The absolute values of these contributions, at their largest, times the
    multipliers of the rows and `ROW_ROUNDING`, are the allowance for the rounding of them all (Higham 2002, section
    3.1). A piece of the control whose switching function is below its price by more than that contributes 0 to the
    bound, whatever is rounded (`_sum_control_magnitudes`).

    Further errors are subtracted as well. A multiplier of the wrong sign has an error (`_bound_sign_error`).
    Transitions have a relative error (`_estimate_transition_error`), and the truncation error of a law as a series in
    the parameters (`_bound_law_truncation`). With fewer functions than pieces, multipliers of the pieces have rounding
    errors too (`_bound_image_error`). ``prices (n,)`` are the prices of the decision, where the bound is the least
    cost of the sizes of its entries at these prices.
    """
    if not np.isfinite(result.lower_bound) or result.lower_bound <= 0.0:  # without multipliers 0 is exact
        return result
    share = ROW_ROUNDING + _estimate_transition_error(model)
    error = share * (
        _sum_row_magnitudes(model, result, share, prices) + _sum_tangent_magnitudes(model, result) + result.lower_bound
    )
    error += _bound_sign_error(model, result) + _bound_law_truncation(model, result) + _bound_image_error(model, result)
    lowered = max(0.0, result.lower_bound - error)
    dual = replace(result.dual, bound=min(result.dual.bound, lowered))
    answer = replace(result, lower_bound=lowered, dual=dual)
    if answer.status != "certified" or tolerance is None or answer.gap <= tolerance + SMALL_GAP:
        return answer
    message = f"the constraints are proven for the whole continuum; rounding leaves a gap of {answer.gap:.1e}"
    return replace(answer, status="verified", message=message)


def _estimate_transition_error(model: Transcription) -> float:
    """Return the relative error of transitions. For a system that changes with time it is the truncation error of their
    expansion.

    Otherwise it is an estimate at a middle parameter: one rounding for every time in which the system moves by its
    size. Transitions over a long time are squares of transitions over a short one (Moler and Van Loan 2003, method 3).
    The transitions of a known system are rounded once, but later products with rows may cancel as much.
    """
    if model.response.system.varies:
        return model.response.propagator.slack
    middle = np.zeros(0) if model.parameters.set is None else model.parameters.set.interior_point()
    fastest = max(pace(mode.matrices(middle[None])[0][0]) for mode in model.response.system.modes)
    return EPSILON * fastest * model.problem.horizon


def _sum_row_magnitudes(model: Transcription, result: Result, share: float, prices: Array | None) -> float:
    """Return the sum over all rows with a multiplier of the multiplier times the absolute numbers that are added up to
    the row. A ``share`` of this sum may be lost by rounding; ``prices`` as in `reduce_bound`."""
    middle = model.parameters.middle
    rows, extra, uses_prices = [], 0.0, prices is not None
    for cut, explanation in zip(result.dual.cuts, model.explained(result.dual.cuts), strict=True):
        constraint = model.constraint(model.program.family(cut.family))
        if explanation is not None and constraint is not None and cut.multiplier > 0.0:
            rows.append((cut.multiplier, explanation.time, explanation.direction, explanation.parameter_or(middle)))
            if explanation.gain is not None:
                extra += cut.multiplier * float(np.abs(explanation.gain) @ extent(model.problem.control))
            extra += cut.multiplier * float(constraint.reference.reach(explanation.direction))
            uses_prices = uses_prices and explanation.gain is None
        elif cut.multiplier > 0.0:
            uses_prices = False
    for axis, price in zip(fixed(model.problem)[0], result.dual.mu, strict=False):
        rows.append((float(price), model.problem.horizon, axis, middle))
    if not rows:
        return 0.0
    multipliers, *indices = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    times, directions, parameters = indices[0], indices[1], indices[2].reshape(len(rows), -1)
    weights = model.response.weights(times, directions, parameters)
    sizes = np.abs(multipliers) @ _sum_other_contributions(model, weights, times, directions, parameters)
    prices = prices if uses_prices and _is_priced_box(model, result) else None
    return float(sizes) + extra + _sum_control_magnitudes(model, prices, weights.control, multipliers, share)


def _is_priced_box(model: Transcription, result: Result) -> bool:
    """Return whether the bound depends only on rows, and on the box and the price of every entry of the decision."""
    finite, m = model.program.finite, model.problem.system.controls
    is_plain = finite.S is None and finite.P is None and finite.blocks is None and not finite.q.any()
    return is_plain and result.dual.z is None and finite.n == m * model.control.pieces


def _sum_control_magnitudes(
    model: Transcription, prices: Array | None, weights: Array, multipliers: Array, share: float
) -> float:
    """Return the largest sum of absolute contributions of the control to rows with ``multipliers (k,)`` and ``weights
    (k, L, m)``.

    The bound is the least value of ``sum_j (w_j |u_j| + r_j u_j)`` over a box, with the ``prices`` ``w`` and the sum
    ``r`` of the rows. Where the box contains 0, the least value is attained at ``u_j = 0`` for every ``|r_j| <= w_j``.
    So the sum has only entries whose ``|r_j|`` is not below ``w_j`` by more than a ``share`` of the largest numbers in
    their channel. All entries count where the bound is of another form, and there are no prices.
    """
    sizes = np.tensordot(np.abs(multipliers), _bound_control_contributions(model, weights), 1)
    if prices is not None:
        grid, finite = model.response.grid, model.program.finite
        functionals, m = model.functionals, model.problem.system.controls
        switching = multipliers @ functionals.on_decision(weights)
        magnitudes = np.abs(multipliers) @ functionals.on_decision(np.abs(weights))
        magnitudes = np.repeat(magnitudes.reshape(m, -1).max(axis=1, initial=0.0), model.control.pieces)
        is_zero = (np.abs(switching) + share * magnitudes < prices) & (finite.lower <= 0.0) & (finite.upper >= 0.0)
        sizes[is_zero.reshape(m, -1)[:, grid.control_piece[grid.decided]].T] = 0.0
    return float(sizes.sum())


def _bound_law_truncation(model: Transcription, result: Result) -> float:
    """Return an upper bound of the truncation error of a law as a series in the parameters, over all rows with a
    multiplier."""
    truncation, error = model.functionals.over_cells.truncation(extent(model.problem.control)), 0.0
    if truncation.any():
        for cut, explanation in zip(result.dual.cuts, model.explained(result.dual.cuts), strict=True):
            error += (
                0.0
                if explanation is None
                else abs(cut.multiplier) * float(np.abs(explanation.direction[: truncation.size]) @ truncation)
            )
    return error


def added_up(model: Transcription, times: Array, directions: Array, parameters: Array) -> Array:
    """Return the largest sums ``(k,)`` of absolute numbers that are added up to rows ``c'x(t)``, ``directions (k,
    d)``."""
    weights = model.response.weights(times, directions, parameters)
    sums = _sum_other_contributions(model, weights, times, directions, parameters)
    return np.asarray(sums + _bound_control_contributions(model, weights.control).sum(axis=(1, 2)))


def _bound_control_contributions(model: Transcription, weights: Array) -> Array:
    """Return the largest absolute contributions ``(k, J, m)`` of every piece of the control to rows with ``weights (k,
    L, m)``."""
    return np.asarray(np.abs(model.functionals.decided(weights)) * extent(model.problem.control))


def _sum_other_contributions(
    model: Transcription, weights: Weights, times: Array, directions: Array, parameters: Array
) -> Array:
    """Return the largest sums ``(k,)`` of absolute contributions to rows ``c'x(t)``, without the contribution of the
    control."""
    functionals, free = model.functionals, np.abs(weights.free)
    sizes = free @ np.abs(model.response.initial_state)
    if model.problem.initial_set is not None:
        sizes += free @ extent(model.problem.initial_set)
    sizes += np.einsum("klm,ml->k", np.abs(weights.control), np.abs(functionals.known))
    if functionals.execution is not None:
        lengths = functionals.execution.lengths(times, functionals.execution.extend_directions(directions, parameters))
        sizes += INTEGRATED * (lengths @ np.repeat(extent(model.problem.control), functionals.dictionary.pieces))
    return np.asarray(sizes + _sum_disturbance_contributions(model, weights.disturbance, times, directions, parameters))


def _sum_disturbance_contributions(
    model: Transcription, on_noise: Array, times: Array, directions: Array, parameters: Array
) -> Array:
    """Return the largest sums ``(k,)`` of absolute contributions of disturbances, from the weights ``on_noise (k, L,
    mw)``."""
    if model.problem.disturbance is None:
        return np.zeros(times.size)
    sizes: Array = (np.abs(on_noise) @ extent(model.problem.disturbance)).sum(axis=1)
    measurable = model.functionals.measurable
    if measurable is None:
        return sizes
    return sizes + INTEGRATED * measurable.integrated_sizes(times, directions, parameters)


def _sum_tangent_magnitudes(model: Transcription, result: Result) -> float:
    """Return the largest sum of absolute numbers that are added up to the tangent of the quadratic terms. The slope ``P
    at`` may be small because these numbers cancel, as along a flat direction of ``P``; their rounding does not become
    small."""
    finite, at = model.program.finite, result.dual.at
    if finite.P is None or at is None:
        return 0.0
    magnitudes = _bound_coefficients(model)
    slopes, at, q = (np.abs(model.nominal(values)) for values in (np.asarray(abs(finite.P) @ np.abs(at)), at, finite.q))
    return float(abs(finite.constant) + 0.5 * at @ slopes + (q + slopes) @ magnitudes)


def _bound_coefficients(model: Transcription) -> Array:
    """Return the largest absolute value of each coefficient of the control, ``(m N,)``."""
    reach = model.problem.control.reach(np.eye(model.problem.system.controls))
    if model.program.finite.S is None:
        return np.repeat(reach, model.control.pieces)
    return np.asarray(np.kron(reach, np.abs(np.linalg.pinv(model.control.values.T)).sum(axis=1)))


def _bound_image_error(model: Transcription, result: Result) -> float:
    """Return an upper bound of the effect of errors in the multipliers of the image: their difference from the slopes
    that they represent, times the largest coefficients. The difference is the rounding of the sums that convert one
    into the other (Higham 2002, section 3.1)."""
    S, z = model.program.finite.S, result.dual.z
    if S is None or z is None:
        return 0.0
    terms = int(np.diff(S.tocsc().indptr).max(initial=0))
    sizes = model.nominal(np.asarray(abs(S).T @ np.abs(z)))
    return float((terms + 8) * EPSILON * np.abs(sizes) @ _bound_coefficients(model))


def _bound_sign_error(model: Transcription, result: Result) -> float:
    """Return an upper bound of the effect of multipliers of the wrong sign on slanted sides ``H u <= h`` of the
    controls' set and of the set of their steps, with the rounding of the sums with these multipliers.

    In the program, ``s = H u`` has no lower bound, so only ``z >= 0`` proves anything about ``-z s``. A negative ``z``
    within its own rounding counts as 0 there. On the set, ``-z s`` is at least ``z`` times the largest ``-H u``.
    """
    if result.dual.z is None:
        return 0.0
    (H, h), bound = slanted_sides(model.problem.control), model.problem.control
    controls, pieces = model.problem.system.controls, model.control.pieces
    sides, remaining = np.split(result.dual.z[controls * pieces :], [h.size * pieces])
    error = float(np.maximum(-sides, 0.0).reshape(h.size, pieces).sum(axis=1) @ np.maximum(bound.support(-H), 0.0))
    # of opposite sides of a set without interior multipliers may be as large as they like
    error += ROW_ROUNDING * float(np.abs(sides).reshape(h.size, pieces).sum(axis=1) @ (np.abs(H) @ extent(bound)))
    steps = Steps.of(model.problem, model.control)
    if steps.count:
        own = remaining[: steps.upper.size * steps.times.size]  # what follows bounds sizes from both sides
        step_multipliers, magnitudes = (
            own.reshape(steps.upper.size, steps.times.size),
            2.0 * np.abs(steps.H) @ extent(bound),
        )
        wrong_signs = np.where(np.isfinite(steps.upper), 0.0, np.maximum(step_multipliers, 0.0).sum(axis=1))
        wrong_signs += np.where(np.isfinite(steps.lower), 0.0, np.maximum(-step_multipliers, 0.0).sum(axis=1))
        error += float((wrong_signs + ROW_ROUNDING * np.abs(step_multipliers).sum(axis=1)) @ magnitudes)
    return error
