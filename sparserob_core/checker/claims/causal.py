"""The lower bound of the cost of every causal policy, derived anew in balls from signals and multipliers alone.

A control on piece ``k`` depends only on the disturbance before ``tau_k``, or before the last measurement that is known
by then, whatever is measured. So it is one vector for all signals that agree until then.

Where outputs with noise are measured, a control depends on these alone. Each signal then names its outputs relative to
the nominal ones, as exact numbers. The noise is the difference between these outputs and the effect of the signal's
disturbance and initial state. This noise is derived in balls and must be proven to be in its set. The control is one
vector for all signals whose known outputs are the same numbers. The argument holds piece by piece, since the same
controls so far lead to the same outputs.

So for every causal policy a weighted sum of constraints under the signals has a lower bound. The bound is the constant
part of the sum, plus the minimum over each such vector in the set of the control, with the vector's part of the
cost."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
from flint import arb

from sparserob_core.checker.arithmetic.balls import ball, balls
from sparserob_core.checker.claims.answers import PEAK, WORST
from sparserob_core.checker.claims.case import Case, listed, number, numbers
from sparserob_core.checker.claims.multipliers import MAX_MULTIPLIERS
from sparserob_core.checker.cost.duality import ConstraintRow
from sparserob_core.checker.outcome import Broken, Unchecked
from sparserob_core.checker.sets.known import known, middle
from sparserob_core.checker.sets.shape import find_range
from sparserob_core.sip.convex_set import Array

WeightedRow: TypeAlias = (
    "tuple[ConstraintRow, list[list[arb]], list[arb]]"  # a row, its weights of the disturbance and the initial state
)
Rows: TypeAlias = dict[tuple[str, float, bytes], WeightedRow]
SHARE = 1.0 - 2.0**-40  # of a price is shared, so that rounding does not share more than the price


def causal_bound(case: Case, data: Mapping[str, Any], priced: bool) -> arb:
    """Return a ball whose lower end is the bound that the signals and multipliers of an entry ``causal`` prove for
    every causal policy. Where ``priced`` it bounds the cost; else the weighted sum of the constraints, which no causal
    policy meets where that is positive."""
    _require_supported(case)
    signals, nominal_report = _read_signals(case, data), middle_of(case)
    K, m, total = case.control.pieces, case.problem.system.controls, ball(0)
    changes = case.disturbances.changes or []
    breakpoints, measurements = case.control.breakpoints, case.problem.measurements
    latest_times = breakpoints[:-1] if measurements is None else measurements.latest(breakpoints)
    # blocks that begin before the last known measurement
    known_blocks = [bisect_left(changes, float(t)) for t in latest_times]
    reports, initial_deviations = signals, None
    if measurements is not None and "outputs" in data:
        known_blocks = measurements.known(breakpoints).sum(axis=1).tolist()
        initial_deviations = _read_initial_deviations(case, data, len(signals))
        reports, nominal_report = (
            _read_outputs(case, data, signals, initial_deviations, max(known_blocks)),
            np.zeros((measurements.outputs, K)),
        )
    groups: list[dict[bytes, list[arb]]] = [{_encode_prefix(nominal_report, n): [ball(0)] * m} for n in known_blocks]
    entries = listed(data, "multipliers")
    if len(entries) > MAX_MULTIPLIERS:
        raise Broken(f"{len(entries)} multipliers are too many to be checked")
    rows_by_key: Rows = {}
    for entry in entries:
        case.clock.check()
        y, signal_index, (row, disturbance_weights, initial_weights) = _read_entry(
            case, entry, len(signals), rows_by_key
        )
        weight, signal = ball(y), signals[signal_index]
        terms = [a * ball(w) for block, column in zip(disturbance_weights, signal.T, strict=True)
                 for a, w in zip(block, column, strict=True)]  # fmt: skip
        terms += (
            []
            if initial_deviations is None
            else [c * x for c, x in zip(initial_weights, initial_deviations[signal_index], strict=True)]
        )
        total = total + weight * sum(terms, row.constant)
        for k in range(K):
            if any(not x.is_zero() for x in row.slope[k]):
                group = groups[k].setdefault(_encode_prefix(reports[signal_index], known_blocks[k]), [ball(0)] * m)
                group[:] = [a + weight * x for a, x in zip(group, row.slope[k], strict=True)]
    shares = _read_shares(data, len(signals)) if priced and case.charge == WORST else None
    for k in range(K):
        prices: dict[bytes, arb] = {_encode_prefix(nominal_report, known_blocks[k]): ball(1)} if shares is None else {}
        for report, share in zip(reports, shares or (), strict=False):
            key = _encode_prefix(report, known_blocks[k])
            prices[key] = prices.get(key, ball(0)) + share
            groups[k].setdefault(key, [ball(0)] * m)
        total = total + _bound_piece(case, k, groups[k], prices, priced)
    return total


def _read_shares(data: Mapping[str, Any], count: int) -> list[arb]:
    """Return the weights of the efforts under the signals; their weighted sum is at most the largest effort. Raise
    `Broken` unless no weight is negative and their sum is at most 1."""
    shares = numbers(data.get("shares", []), "causal: shares")
    if shares.shape != (count,) or not (shares >= 0.0).all():
        raise Broken(f"causal: expected shares of {count} signals, not below 0")
    share_balls = balls(shares)
    if not sum(share_balls, ball(0)) <= 1:
        raise Broken(f"causal: the shares of the signals add up to {shares.sum()!r}, expected at most 1")
    return share_balls


def _require_supported(case: Case) -> None:
    """Raise `Unchecked` for problems whose causal policies the checker does not bound."""
    if case.policy is None or case.problem.system.parameter_count or not case.problem.cost.is_linear:
        raise Unchecked("the checker bounds causal policies of known systems, with the cost of an L1 norm, only")
    if not case.control.is_indicators:
        raise Unchecked("the checker bounds causal policies in indicators")


def _read_entry(case: Case, entry: object, signals: int, rows: Rows) -> tuple[float, int, WeightedRow]:
    """Return the multiplier of an entry, the number of its signal, and its constraint. With the constraint come the
    weights of the disturbance and of the initial state in it."""
    if not isinstance(entry, Mapping):
        raise Broken("causal: expected a signal, a constraint, a time, a direction and a number each")
    name, time, y = str(entry.get("constraint")), number(entry, "time"), number(entry, "multiplier")
    direction, signal_index = numbers(entry.get("direction"), f"{name}: direction"), entry.get("signal")
    if not y > 0:
        raise Broken(f"causal: a multiplier of {name} is {y!r}, expected a positive number")
    if not isinstance(signal_index, int) or isinstance(signal_index, bool) or not 0 <= signal_index < signals:
        raise Broken(f"causal: there is no signal {signal_index!r}")
    window = case.window(name)
    if window.is_mixed or direction.shape != (case.problem.system.states,):
        raise Broken(f"causal: {name}: {direction.size} numbers where {case.problem.system.states} are expected")
    if not window.start <= time <= window.stop:
        raise Broken(f"causal: {name}: t = {time!r} is not within {window.start:g} to {window.stop:g}")
    key = (name, time, direction.tobytes())
    if key not in rows:
        row, initial_weights = (
            case.duality.row(direction, time, [], window.limit(direction, time), disturbed=False),
            list[Any](),
        )
        if case.problem.initial_set is not None:  # its middle is one of the initial states
            initial_middle = middle(case.problem.initial_set)
            if not known(case.problem.initial_set).contains(initial_middle):
                raise Unchecked("the middle of the initial states is not shown to be one of them")
            initial_weights = case.duality.compute_initial_weights(direction, time)
            row = replace(
                row,
                constant=sum(
                    (c * x for c, x in zip(initial_weights, balls(initial_middle), strict=True)), row.constant
                ),
            )
        rows[key] = row, case.duality.compute_disturbance_weights(direction, time), initial_weights
    return y, signal_index, rows[key]


def middle_of(case: Case) -> Array:
    """Return the nominal signal ``(mw, blocks)``, which is the middle of the set of disturbances throughout."""
    shape = case.problem.disturbance
    if shape is None:
        return np.zeros((0, 0))
    return np.repeat(middle(shape)[:, None], len(case.disturbances.changes or []), axis=1)


def _encode_prefix(signal: Array, blocks: int) -> bytes:
    """Return the first ``blocks`` columns of a signal as bytes, which are equal for equal numbers."""
    return np.ascontiguousarray(signal[:, :blocks] + 0.0).tobytes()


def _read_signals(case: Case, data: Mapping[str, Any]) -> list[Array]:
    """Return the signals ``(mw, blocks)``; raise `Broken` unless all are shown to be in the set of disturbances."""
    signals, shape = [], case.problem.disturbance
    for entry in listed(data, "signals"):
        case.clock.check()
        if shape is None:
            signals.append(np.zeros((0, 0)))
            continue
        w = numbers(entry, "causal: signal")
        expected = shape.dimension, len(case.disturbances.changes or [])
        if w.shape != expected:
            raise Broken(f"causal: a signal of shape {w.shape}, expected {expected}")
        for column in np.unique(w.T, axis=0):
            if not known(shape).contains(column):
                raise Broken(f"causal: the disturbance {column.tolist()} is not shown to be in its set")
        signals.append(w)
    return signals


def _read_initial_deviations(case: Case, data: Mapping[str, Any], count: int) -> list[list[arb]]:
    """Return for every signal the deviation ``(d,)`` of its initial state, shown to be in its set, from the middle of
    the set; empty where there is no set."""
    shape, entries = case.problem.initial_set, listed(data, "initial_states")
    if len(entries) != count:
        raise Broken(f"causal: {len(entries)} initial states of {count} signals")
    if shape is None:
        return [[] for _ in entries]
    initial_middle, deviations = balls(middle(shape)), []
    for entry in entries:
        start = numbers(entry, "causal: initial state")
        if start.shape != (shape.dimension,) or not known(shape).contains(start):
            raise Broken(f"causal: the initial state {start.tolist()} is not shown to be in its set")
        deviations.append([a - b for a, b in zip(balls(start), initial_middle, strict=True)])
    return deviations


def _read_outputs(
    case: Case, data: Mapping[str, Any], signals: list[Array], initial_deviations: list[list[arb]], known_at_all: int
) -> list[Array]:
    """Return the outputs ``(p, K)`` under every signal, relative to the nominal ones. At the first ``known_at_all``
    breakpoints what remains of each must be shown to be a noise of the set."""
    measurements, entries, times = case.problem.measurements, listed(data, "outputs"), case.control.breakpoints
    assert measurements is not None
    C, K = np.asarray(measurements.C, dtype=float), case.control.pieces
    if measurements.noise is None or len(entries) != len(signals):
        raise Broken(f"causal: outputs of {len(entries)} signals, expected those of {len(signals)}, under a noise")
    noise_middle, nominal_columns = balls(middle(measurements.noise)), [balls(x) for x in middle_of(case).T]
    outputs_by_signal = [numbers(entry, "causal: outputs") for entry in entries]
    for outputs in outputs_by_signal:
        if outputs.shape != (K, measurements.outputs):
            raise Broken(f"causal: outputs of shape {outputs.shape}, expected {(K, measurements.outputs)}")
    for j in range(known_at_all):
        time = float(times[j])
        disturbance_weights = (
            [case.duality.compute_disturbance_weights(row, time) for row in C] if j else [[] for _ in C]
        )
        initial_weights = [case.duality.compute_initial_weights(row, time) if j else balls(row) for row in C]
        for w, deviation, outputs in zip(signals, initial_deviations, outputs_by_signal, strict=True):
            case.clock.check()
            noise = []
            for a in range(measurements.outputs):
                contributions = [c * x for c, x in zip(initial_weights[a], deviation, strict=True)] if deviation else []
                for block, column, nominal_column in (
                    zip(disturbance_weights[a], [balls(x) for x in w.T], nominal_columns, strict=True) if j else ()
                ):
                    contributions += [
                        c * (x - m) for c, x, m in zip(block, column, nominal_column, strict=True) if not c.is_zero()
                    ]
                noise.append(sum((-x for x in contributions), noise_middle[a] + ball(outputs[j, a])))
            if not known(measurements.noise).holds(noise):
                raise Broken(f"causal: no noise is shown to make what is said to be measured at t = {time:.6g}")
    return [np.ascontiguousarray(outputs.T) for outputs in outputs_by_signal]


def _bound_piece(case: Case, k: int, groups: dict[bytes, list[arb]], counts: dict[bytes, arb], priced: bool) -> arb:
    """Return a lower bound of what the controls on one piece contribute to the weighted sum and the cost: of each group
    of signals one vector, with the slope ``groups[key]`` and the part ``counts[key]`` of the price."""
    m, control = case.problem.system.controls, case.problem.control
    prices = case.price.costs[k] if priced else [ball(0)] * m
    total, zero = ball(0), [ball(0)] * m
    shares = dict.fromkeys(groups, zero) | {key: [share * price for price in prices] for key, share in counts.items()}
    if priced and case.charge == PEAK:
        shares = _share_peak_price(case, prices, groups)
    for key, slope in groups.items():
        total = total + known(control).least(shares[key], shares[key], slope)
    return total


def _share_peak_price(case: Case, prices: list[arb], groups: dict[bytes, list[arb]]) -> dict[bytes, list[arb]]:
    """Return the part of the price of a channel's peak that each group pays, as far as it can lower its slope. The sum
    of the parts is at most the price, since ``max_g |u_g|`` is at least every mean of ``|u_g|``."""
    shares = {key: [ball(0)] * len(prices) for key in groups}
    for i, price in enumerate(prices):
        low, high = find_range(known(case.problem.control), i)
        largest_values = {key: float((high if slope[i] < 0 else -low).mid()) for key, slope in groups.items()}
        remaining_price = float(price.lower()) * SHARE
        for key in sorted(groups, key=lambda key: -largest_values[key]):
            share = min(remaining_price, abs(float(groups[key][i].mid()))) if largest_values[key] > 0.0 else 0.0
            share = max(share * SHARE, 0.0)
            shares[key][i] = ball(share)
            remaining_price -= share
        shares[next(iter(groups))][i] += ball(max(remaining_price * SHARE, 0.0))
    return shares
