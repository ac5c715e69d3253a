"""One trajectory, for one disturbance and one parameter that must be admissible."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.claims.case import Case, number, numbers
from sparserob_core.checker.outcome import TOLERANCE, Broken, Unchecked
from sparserob_core.checker.reach.flow import flows, held, stacked
from sparserob_core.checker.reach.tube import Tube
from sparserob_core.checker.reach.varying.flow import VaryingFlow
from sparserob_core.checker.reach.varying.tube import VaryingTube
from sparserob_core.checker.sets.known import known
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat


def reached(case: Case, time: float, parameter: Array, signal: object, deviation: object = None) -> list[arb]:
    """The state at ``time`` under the case's control, and ``signal (mw, pieces)`` on the pieces of the common grid
    (``None``: no disturbance), from the centre of the initial states and a ``deviation (d,)`` in their set."""
    from flint import arb, arb_mat

    if case.changing is not None:
        return _changed(case, case.changing, time, signal, deviation)
    every = [flow.parts for flow in flows(case.problem.system, parameter.tolist())]
    wanted = case.problem.disturbance is not None
    w = _admissible(case, signal) if wanted else None
    both = [
        stacked([left + right for left, right in zip(parts["B"][0].tolist(), parts["E"][0].tolist(), strict=True)])
        for parts in every
    ]
    x = _start(case, deviation)
    for k, start in enumerate(case.grid[:-1]):
        if start >= time:
            break
        leg = case.scene.leg(k)
        Phi, Gamma = held(every[leg]["A"][0], both[leg], arb(min(case.grid[k + 1], time)) - arb(start))
        pushed = [arb(0)] * every[leg]["E"][0].ncols() if w is None else balls(w[:, k])
        x = Phi * x + Gamma * arb_mat([[v] for v in case.scene.control[k].entries() + pushed])
    state: list[arb] = x.entries()
    return state


def _changed(case: Case, flow: VaryingFlow, time: float, signal: object, deviation: object) -> list[arb]:
    """`reached` of a system that changes with time."""
    w = _admissible(case, signal) if case.problem.disturbance is not None else None
    weights = flow.weights([0.0, *(t for t in case.grid[1:-1] if t < time), time])
    x = weights.free * _start(case, deviation)
    for k, (acts, pushes) in enumerate(zip(weights.control, weights.disturbance, strict=True)):
        x = x + acts * case.scene.control[k]
        if w is not None:
            x = x + pushes * stacked([[v] for v in balls(w[:, k])])
    state: list[arb] = x.entries()
    return state


def _start(case: Case, deviation: object) -> arb_mat:
    """The initial state ``(d, 1)`` that a deviation leads to."""
    begin = balls(np.asarray(case.problem.initial_state))
    if case.problem.initial_set is not None:
        begin = [v + off for v, off in zip(begin, balls(_begun(case, deviation)), strict=True)]
    return stacked([[v] for v in begin])


def exceeded(case: Case, said: Mapping[str, object], begun: Array | None = None) -> tuple[list[float], float]:
    """By how much the worst disturbance exceeds each row of a constraint at one time and parameter, and how closely
    that is known; from the worst initial state, or from ``begun (d,)``. `said` holds the names ``constraint``,
    ``time``, ``parameter`` and ``violation``. Raises `Broken` where these are none, `Unchecked` for a curved set."""
    name = str(said.get("constraint"))
    of_control = {case.of_control: case.problem.control, "control_step": case.problem.control_step}.get(name)
    if of_control is not None and known(of_control).facets is None:
        raise Unchecked("the worst direction of a curved set is not told")
    window, time = case.window(name), number(said, "time")
    parameter = numbers(said.get("parameter"), "parameter")
    number(said, "violation")
    if parameter.shape != (case.problem.system.parameter_count,):
        raise Broken(f"parameter: {parameter.size} numbers where {case.problem.system.parameter_count} are expected")
    if not window.start <= time <= window.stop:
        raise Broken(f"t = {time!r} is not within {window.start:g} to {window.stop:g}")
    flat, found = window.seen.facets, window.seen.basis
    if flat is None or found is None:
        raise Unchecked("the worst direction of a curved set is not told")
    (basis, gains), z = np.split(found[0], [window.states], axis=1), found[1]
    scene = case.scene if begun is None else replace(case.scene, initial_state=begun.tolist(), initial_set=None)
    tube = (
        Tube(flows(case.problem.system, parameter.tolist()), scene, basis)
        if case.changing is None
        else VaryingTube(case.changing, scene, basis)
    )
    piece = min(bisect_right(case.grid, time) - 1, len(case.grid) - 2 if time < case.grid[-1] else len(case.grid) - 1)
    polynomials, beside = tube.cells(piece, time, time, z), case.beside(window, basis, gains)
    breaks: list[int | None] = [None]
    if window.is_mixed:  # where the control jumps, either of its values
        ends = case.control.breakpoints
        pieces = [int(np.searchsorted(ends, time, side=side)) - 1 for side in ("left", "right")]
        breaks = [*{max(0, min(piece, case.control.pieces - 1)) for piece in pieces}]
    if beside is not None:
        polynomials = [p for k in breaks for p in beside.added(polynomials, time, time, z, k)]
    limits = [float(b.mid()) for _, b in flat] * len(breaks)
    over = [float(poly.coefficients[0, 0]) - b for poly, b in zip(polynomials, limits, strict=True)]
    slack = max(float(poly.error) for poly in polynomials) + TOLERANCE * float(case.units(window).rows.max(initial=0.0))
    return over, slack


def _begun(case: Case, data: object) -> Array:
    """The deviation of the initial state, shown to be one of the problem's."""
    bound = case.problem.initial_set
    assert bound is not None
    deviation = numbers(data, "deviation")
    if deviation.shape != (bound.dimension,):
        raise Broken(f"deviation: expected {bound.dimension} numbers, got shape {deviation.shape}")
    if not known(bound).contains(deviation):
        raise Broken(f"the deviation {deviation.tolist()} of the initial state is not shown to be in its set")
    return deviation


def _admissible(case: Case, signal: object) -> Array:
    """The disturbance, shown to be one of the problem's."""
    changes, bound = case.changes, case.problem.disturbance
    assert changes is not None and bound is not None
    w = numbers(signal, "disturbance")
    if w.ndim != 2 or w.shape[0] != bound.dimension:
        raise Broken(f"disturbance: expected {bound.dimension} rows, got shape {w.shape}")
    if w.shape[1] != len(case.grid) - 1:
        raise Unchecked("the disturbance is given on another grid")
    jumps = set(changes)
    for k in range(w.shape[1]):
        if k and case.grid[k] not in jumps and not np.array_equal(w[:, k], w[:, k - 1]):
            raise Broken(f"the disturbance jumps at t = {case.grid[k]:.6g}, within a piece")
        if not known(bound).contains(w[:, k]):
            raise Broken(f"the disturbance {w[:, k].tolist()} at t = {case.grid[k]:.6g} is not shown to be in its set")
    return w
