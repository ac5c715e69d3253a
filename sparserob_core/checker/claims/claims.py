"""The claims of a certificate, each derived anew from the problem's data in ball arithmetic."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from flint import arb, arb_mat, ctx

from sparserob_core.checker.arithmetic.balls import ball, below
from sparserob_core.checker.arithmetic.series import exactly, stacked
from sparserob_core.checker.claims import activity
from sparserob_core.checker.claims.answers import feedback_of
from sparserob_core.checker.claims.case import EQUALS, STEP, Case, listed, lost_by, number, numbers, written_policy
from sparserob_core.checker.claims.cells import Work, prove
from sparserob_core.checker.claims.constraints import bounded, equalities
from sparserob_core.checker.claims.multipliers import multiplied, weighted
from sparserob_core.checker.claims.replay import excused, witnessed
from sparserob_core.checker.claims.units import units_of
from sparserob_core.checker.claims.window import ConstraintWindow
from sparserob_core.checker.cost.duality import ConstraintRow, steps
from sparserob_core.checker.outcome import CANCELLED, FIGURES, TOLERANCE, Broken, Finding, Unchecked
from sparserob_core.checker.problem.returning import single
from sparserob_core.checker.reach.tube import TimelessTube
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.parameters import Parameters
from sparserob_core.checker.sets.shape import Shape, excess
from sparserob_core.checker.sets.sides import Curved, Sides
from sparserob_core.control.policies.policy import WrittenPolicy
from sparserob_core.control.problem.names import unit_of_row
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, ConvexSet

PRECISION = 96  # bits, where the numbers of a system are of one size
MAX_PRECISION = 1024
VARYING = 96  # further bits for trees of products, where radii grow at each level; half of it shows after ten orbits
SMALL_COST = 1e-6  # share of what is added up to a cost; a gap is relative to at least this share
SMALL_GAP = 1e-11  # a gap that was closed may open by the rounding error that is subtracted from the lower bound
# Share of what is added up to a cost, or of 1, by which a derived lower bound may exceed the cost: excused violations
# allow that, by their multipliers. A larger excess is a contradiction between two proofs, of which one is wrong.
CONTRADICTION = 1e-4
ASIDE = ("fewest active", "causal")  # claims that the status does not rest on


def check(case: Case, gap_tolerance: float | None) -> list[Finding]:
    """Return one verdict per claim of the certificate; nothing that the file says is believed. ``gap_tolerance`` is the
    relative gap up to which the config calls a control certified, or ``None``."""
    status = case.certificate.get("status")
    with ctx.workprec(precision_of(case)):
        if type(case.certificate.get("format")) is not int or case.certificate["format"] != 1:
            return [Finding("certificate", "fails", f"its format is {case.certificate.get('format')!r}, expected 1")]
        causal = [judged("causal", lambda: _verify_causal_bound(case))] if "causal" in case.certificate else []
        policy = [judged("policy", lambda: _verify_policy(case))] if "policy" in case.certificate else []
        if status == "infeasible":
            return [*policy, judged("infeasibility", lambda: _verify_infeasibility(case)), *causal]
        if status not in ("certified", "verified", "refuted", "undecided"):
            return [Finding("status", "fails", f"it is {status!r}, which claims nothing")]
        if status == "undecided" and case.certificate.get("decision") is None:  # stopped before there was one
            return [*policy, judged("lower bound", lambda: _verify_lower_bound(case)), *causal]
        claims = [*policy, _qualify_finding(str(status), judged("control", lambda: _verify_control(case)))]
        claims.append(judged("cost", lambda: _verify_cost(case)))
        claims += [judged("lower bound", lambda: _verify_lower_bound(case))]
        if "fewest_active" in case.certificate:
            claims.append(judged("fewest active", lambda: _verify_fewest_active(case, str(status))))
        claims += causal
        if status == "refuted":
            return [*claims, judged("violation", lambda: _verify_witness(case))]
        if case.problem.control_step is not None:
            claims.append(_qualify_finding(str(status), judged("control_step", lambda: _verify_steps(case))))
        if case.equalities:
            claims.append(_qualify_finding(str(status), judged("equalities", lambda: equalities(case))))
        claims += [judged(window.name, lambda window=window: bounded(case, window)) for window in case.windows]  # type: ignore[misc]
        if case.problem.repeat or "repeat" in case.certificate:
            claims.append(
                judged("repeat", lambda: _verify_repeat(case, {claim.name: claim.verdict for claim in claims}))
            )
        return [*claims, judged("status", lambda: _verify_status(case, str(status), gap_tolerance, claims))]


def derived_bound(case: Case) -> float:
    """Return the lower bound of the cost that the certificate's multipliers prove, rounded down. Raise `Broken` or
    `Unchecked` where the multipliers prove none."""
    with ctx.workprec(precision_of(case)):
        return below(multiplied(case, priced=True))


def derived_causal_bound(case: Case, data: Mapping[str, Any], priced: bool) -> float:
    """Return the lower bound that an entry ``causal`` proves for every causal policy, rounded down: of the cost where
    ``priced``, else of the weighted sum of the constraints."""
    from sparserob_core.checker.claims.causal import causal_bound

    with ctx.workprec(precision_of(case)):
        return below(causal_bound(case, data, priced))


def precision_of(case: Case) -> int:
    """Return the bits of a number that the claims of a case need: more where the system's numbers, at one parameter,
    differ by more in the user's units, since an exponential is enclosed in a norm."""
    problem = case.problem
    parameters = problem.system.parameters
    point = np.zeros((1, 0)) if parameters is None else parameters.interior_point()[None]
    try:
        matrices = [matrix for mode in problem.system.modes for matrix in mode.matrices(point)]
    except InputError:  # not finite there
        return PRECISION
    with np.errstate(over="ignore"):  # numbers that are not finite do not count
        entries = np.concatenate([np.ravel(matrix) for matrix in matrices]) * problem.horizon
    sizes = np.abs(entries[np.isfinite(entries) & (entries != 0.0)])
    range_bits = np.log2(max(1.0, sizes.max(initial=1.0))) - np.log2(min(1.0, sizes.min(initial=1.0)))
    extra_bits = VARYING if problem.system.varies else 0
    extra_bits += np.ceil(lost_by(case) / np.log(2.0))
    return int(min(PRECISION + extra_bits + np.ceil(range_bits), MAX_PRECISION))


def judged(name: str, derive: Callable[[], str]) -> Finding:
    """Return the verdict of a derivation that returns a sentence or raises. Where floats overflow, the claim is not
    checked: a comparison with a NaN could pass."""
    try:
        with np.errstate(over="raise", invalid="raise", divide="raise"):
            return Finding(name, "holds", derive())
    except FloatingPointError:
        return Finding(name, "not checked", "the numbers are too large or too small to be compared")
    except Broken as fault:
        return Finding(name, "fails", str(fault))
    except Unchecked as gap:
        return Finding(name, "not checked", str(gap))
    except ZeroDivisionError:
        return Finding(name, "not checked", "a ball around a divisor holds 0")


def _qualify_finding(status: str, found: Finding) -> Finding:
    """Return the verdict on a constraint, given the status of the control. A control that is not proven, such as one at
    which a run was stopped, claims no constraint. So it fails none."""
    if found.verdict != "fails" or status in ("certified", "verified"):
        return found
    return Finding(found.name, "not checked", f"the certificate does not claim it: {found.text}")


def _verify_policy(case: Case) -> str:
    """Show that the written policy, which bounds and gains are about, is the policy of the problem."""
    written = written_policy(case.certificate, case.control.pieces)
    if written.charge.cost != case.charge:
        raise Broken(f"the cost {written.charge.cost} is written, the config asks for {case.charge}")
    gain = None if case.policy is None else case.policy.inner_gain
    if gain is not None and not isinstance(gain, str) and not (case.inner.gains == np.asarray(gain)).all():
        raise Broken("other gains of an inner loop are written than those of the config")
    different = np.argwhere(written.mask != case.answers)
    if different.size:
        k, j = different[0].tolist()
        verb = "is" if written.mask[k, j] else "is not"
        raise Broken(f"that piece {k + 1} answers breakpoint {j + 1} {verb} written, which the config's policy denies")
    description = (
        f"answers {int(case.answers.sum())} of {case.control.pieces * (case.control.pieces + 1) // 2} pairs of a"
    )
    description += f" piece and a measurement before it, and is charged {case.charge}"
    # a component that is not loaded cannot be asked for its policy: then bounds are about the written policy
    return f"it {description}" + (
        ", as is written; its own component is not loaded" if isinstance(case.policy, WrittenPolicy) else ""
    )


def _verify_control(case: Case) -> str:
    """Show that every piece of the control is in its set."""
    commands, places = feedback_of(case).commands, dict[int, int]()
    for k, command in enumerate(commands):
        places.setdefault(id(command), k)
    shown = _verify_in_set(case, case.problem.control, [*places.values()], lambda k: [commands[k]], "{}")
    return f"{len(commands)} pieces in their set{shown}"


def _verify_in_set(
    case: Case, bound: ConvexSet, places: Sequence[int], parts: Callable[[int], list[arb_mat]], name: str
) -> str:
    """Show that a sum of ``parts (m, 1 + Q)`` with independent deviations is in its set on the given pieces, for all
    deviations; return the largest excess in words."""
    shape, feedback, worst, answering_pieces = known(bound), feedback_of(case), 0.0, list[int]()
    for k in places:
        case.clock.check()
        summands = parts(k)
        nominal_parts = ([row[0] for row in summand.tolist()] for summand in summands)
        deviation_support, point = None, [sum(entries, ball(0)) for entries in zip(*nominal_parts, strict=True)]
        if any(not x.is_zero() for summand in summands for row in summand.tolist() for x in row[1:]):
            if shape.facets is None:
                answering_pieces.append(k)
                continue
            responses = [stacked([[ball(0), *row[1:]] for row in summand.tolist()]) for summand in summands]
            deviation_support = lambda c, responses=responses: feedback.heights(responses, exactly(c[None]))[0]  # noqa: E731
        over, where = excess(shape, point, deviation_support)
        if over > TOLERANCE:
            where = name.format("the control" if where == "it" else where)
            at = _format_time(case, float(case.control.breakpoints[k]))
            raise Broken(f"{where} leaves its set by {over:.3g} of its own unit, from {at} on")
        worst = max(worst, over)
    if answering_pieces:
        worst = max(
            worst, _bound_curved_excess(case, shape, answering_pieces, lambda k, rows: feedback.heights(parts(k), rows))
        )
    return f", to {worst:.1e} of its own units" if worst > 0 else ""


def _bound_curved_excess(
    case: Case, shape: Shape, places: Sequence[int], heights: Callable[[int, arb_mat], list[arb]]
) -> float:
    """Show that what answers deviations is in a curved set on the given pieces, in every direction. Return the largest
    excess that was not excluded, along the gauge of the set."""
    m, times = shape.dimension, case.control.breakpoints.tolist()
    curved = Curved(shape, np.diag(1.0 / np.array(shape.radius)), lambda c, width: 0.0)
    work = list[Work]()
    for axis in range(m):
        for sign in (-1.0, 1.0):
            low, high = -np.ones(m), np.ones(m)
            low[axis] = high[axis] = sign
            work.append((((), ()), Sides.cell(curved, low, high), [(k, times[k], times[k]) for k in places]))
    still = TimelessTube(heights, curved.normals)
    return max(0.0, prove(lambda _: still, Parameters(None), work, case.clock).share)


def _verify_repeat(case: Case, verdicts: Mapping[str, str]) -> str:
    """Show that all constraints hold in every period of a plan that repeats: every final state is one of the initial
    states, and the claims about one period hold."""
    if case.certificate.get("repeat") is not True or not case.problem.repeat:
        raise Broken("the certificate and the problem differ about whether the plan repeats")
    if case.problem.system.delay > 0.0:
        raise Broken("with a delay the last controls of a period act in the next one")
    fixed, centre = dict(case.equalities), np.asarray(case.original_problem.initial_state, dtype=float)
    single_states = single(case.original_problem)
    for state in single_states:
        if fixed.get(state) != float(centre[state]):
            name = case.problem.names.state(state)
            raise Broken(f"{name} begins at {float(centre[state])!r}, and does not end there")
    for window in case.returned:
        _require_strict_return(case, window)
    needed = [name for name, verdict in verdicts.items() if name not in (*ASIDE, "cost", "lower bound")]
    for name in needed:
        if verdicts[name] != "holds":
            raise (Broken if verdicts[name] == "fails" else Unchecked)(f"it rests on {name}, which is {verdicts[name]}")
    back = "every final state is one of the initial states"
    if len(single_states) == centre.size:
        back = "the final state is the initial one, to rounding"
    elif single_states:
        back += ", in " + ", ".join(case.problem.names.state(state) for state in single_states) + " to rounding"
    return f"{back}, so that all constraints hold in every period"


def _require_strict_return(case: Case, window: ConstraintWindow) -> None:
    """Raise `Unchecked` unless the set of initial states also holds what the proof of the return excuses."""
    bound = case.original_problem.initial_set
    assert bound is not None
    window_facets, initial_facets = window.enclosed_set.facets, known(bound).facets
    if window_facets is None or initial_facets is None:
        return  # along the gauge a share of the whole set is excused, and the return is proven for a smaller set
    limits, single_states = dict[tuple[float, ...], list[arb]](), {*single(case.original_problem)}
    for c, b in initial_facets:
        if not set(np.flatnonzero(c).tolist()) <= single_states:
            limits.setdefault(tuple(c.tolist()), []).append(b)
    # once for each corner of parameters made states
    normals = [tuple(c[: bound.dimension].tolist()) for c, _ in window_facets]
    if {*normals} != limits.keys():
        raise Unchecked("the sides of the set of initial states are not told apart")
    for normal, (_, limit), unit in zip(normals, window_facets, units_of(case, window).rows.tolist(), strict=True):
        if not all(limit + arb(TOLERANCE) * arb(unit) <= b for b in limits[normal]):
            raise Unchecked(
                f"a violation that counts as none leaves the set of initial states along {[*normal]}: it is too thin"
                " beside the numbers that are added up"
            )


def _verify_steps(case: Case) -> str:
    """Show that every step of the control from piece to piece is in its set."""
    bound, breaks = case.problem.control_step, steps(case.problem, case.control)
    assert bound is not None
    return (
        f"{len(breaks)} steps in their set"
        f"{_verify_in_set(case, bound, breaks, feedback_of(case).changes, 'the change of {}')}"
    )


def _verify_cost(case: Case) -> str:
    """Show that the written cost is the cost of the control."""
    if case.counts:
        return _verify_active_time(case)
    derived = feedback_of(case).cost()
    _require_agreement("cost", number(case.certificate, "cost"), derived, CANCELLED * compared(case))
    return f"J = {float(derived):.12g}{_format_cost_unit(case)}"


def _format_cost_unit(case: Case) -> str:
    """Return the unit of the cost after a space; an empty string where it is not known."""
    return f" {unit}" if (unit := case.problem.cost_unit) else ""


def _verify_active_time(case: Case) -> str:
    """Show that the written time of action and the written cost ``J`` are those of the control. Where there is an
    alphabet, its letters must be the only values of the control."""
    active_share, total = activity.active_share(case), activity.longest_time(case)
    _require_agreement("cost", number(case.certificate, "cost"), ball(active_share * total), 0.0)
    derived = case.price.of(case.pieces)
    _require_agreement(
        "J",
        number(case.certificate, "J"),
        derived,
        CANCELLED * max(case.price.added(case.pieces), case.price.terms(case.pieces)),
    )
    if case.letters is not None and not np.isin(case.control.control(case.theta), case.letters).all():
        raise Broken(f"the control takes other values than {list(case.letters)}")
    unit = f" {case.problem.names.time}" if case.problem.names.time else ""
    return (
        f"it acts for {active_share * total:.9g}{unit} of {total:.9g}{unit},"
        f" J = {float(derived):.12g}{_format_cost_unit(case)}"
    )


def _require_agreement(name: str, written: float, derived: arb, scale: float) -> None:
    """Raise `Broken` unless a written figure is within `FIGURES` times a size of the derived one. The size is
    ``scale``, or the absolute value of the derived figure where that is larger."""
    difference = abs(ball(written) - derived)
    if not difference <= ball(FIGURES) * ball(scale).max(abs(derived)):
        raise Broken(f"{name}: {written!r} is written, {float(derived)!r} is derived")


def _verify_fewest_active(case: Case, status: str) -> str:
    """Show the bounds that the certificate claims of the least share of time that an admissible control must act."""
    data = case.certificate["fewest_active"]
    if not isinstance(data, Mapping):
        raise Broken("fewest_active: expected lower, upper and multipliers")
    written, upper = number(data, "lower"), data.get("upper")
    proven = status in ("certified", "verified")
    if (upper is not None) is not proven:
        raise Broken(f"upper is {upper!r} where the status is {status}")
    other_case = _replace_control(case, data)
    active_share = activity.active_share(other_case)
    if proven and abs(number(data, "upper") - active_share) > FIGURES:
        raise Broken(f"upper is {upper!r}, the control acts for a share of {active_share!r}")
    own_multipliers = data.get("multipliers")
    if case.counts and case.letters is None:
        derived = _bound_by_tree(case) / activity.longest_time(case)
        if not 0.0 <= written <= min(derived, active_share if proven else np.inf) + FIGURES:
            raise Broken(f"lower is {written!r}, the leaves prove {derived!r}")
        return _describe_least_share(case, written)
    if own_multipliers is None and case.problem.cost.blocks and not case.problem.cost.is_quadratic:
        derived = activity.bound_by_cost(case, multiplied(case, priced=True))
    else:
        rows, pieces = weighted(
            case, case.certificate.get("multipliers") if own_multipliers is None else own_multipliers
        )
        rows, pieces = activity.convert_multipliers(case, rows, pieces) if own_multipliers is None else (rows, pieces)
        derived = activity.bound_by_multipliers(case, rows, pieces)
    if not 0.0 <= written <= derived + FIGURES or (proven and written > active_share + FIGURES):
        raise Broken(f"lower is {written!r}, the multipliers prove {derived!r}")
    least = _describe_least_share(case, written)
    return f"{least}, {'this' if other_case is case else 'another'} one {active_share:.1%}" if proven else least


def _describe_least_share(case: Case, share: float) -> str:
    """Return the least share of time that an admissible control acts, in the words of a run."""
    mean = ", the mean over its channels" if case.problem.system.controls > 1 else ""
    return f"every admissible control acts at least {share:.1%} of the time{mean}"


def _replace_control(case: Case, data: Mapping[str, Any]) -> Case:
    """Return the case with another control that the certificate offers, shown to be admissible, or the case itself."""
    if data.get("decision") is None:
        return case
    entries = {name: data.get(name) for name in ("decision", "proof")}
    other_case = replace(case, certificate={**case.certificate, **entries})
    _verify_control(other_case)
    if case.equalities:
        equalities(other_case)
    for window in other_case.windows:
        bounded(other_case, window)
    return other_case


def _verify_lower_bound(case: Case) -> str:
    """Show that no admissible control costs less than the written lower bound."""
    if case.certificate.get("multipliers") is None and case.certificate.get("tree") is None:
        written = number(case.certificate, "lower_bound")
        if written <= 0.0:
            return f"no control costs less than {written:.12g}, for no term of a cost is negative"
    if case.counts:
        written, least = number(case.certificate, "lower_bound"), _bound_by_tree(case)
        if not written <= least + FIGURES * max(1.0, abs(least)):
            raise Broken(f"{written!r} is written, the leaves prove {least!r}")
        return f"no control of these acts for less than {written:.9g} {case.problem.names.time}".rstrip()
    written, derived = number(case.certificate, "lower_bound"), multiplied(case, priced=True)
    if written <= 0.0:  # absolute values, lengths and semidefinite squares need no multiplier for that
        return (
            f"no control costs less than {written:.12g}{_format_cost_unit(case)}, for no term of the cost is negative"
        )
    if not derived >= written:
        raise Broken(f"{written!r} is written, the multipliers prove {float(derived.lower())!r}")
    return f"no control costs less than {written:.12g}{_format_cost_unit(case)}" + (
        f" (the multipliers prove {float(derived.lower()):.12g})"
        if not derived - written < FIGURES * max(1.0, abs(written))
        else ""
    )


def _verify_causal_bound(case: Case) -> str:
    """Show the lower bound of every causal policy, or that no causal policy exists."""
    from sparserob_core.checker.claims.causal import causal_bound

    data = case.certificate["causal"]
    if not isinstance(data, Mapping):
        raise Broken("causal: expected lower_bound, signals and multipliers")
    count = len(listed(data, "signals"))
    if data.get("lower_bound") is None:
        amount = causal_bound(case, data, priced=False)
        if not amount > 0:
            raise Broken(f"causal: the multipliers prove {float(amount.lower()):.3g}, expected a positive number")
        return f"no causal policy exists: under {count} signals a weighted sum of constraints is always missed"
    written, derived = number(data, "lower_bound"), causal_bound(case, data, priced=True)
    if not derived >= written:
        raise Broken(f"causal: {written!r} is written, the multipliers prove {float(derived.lower())!r}")
    return f"no causal policy costs less than {written:.9g}{_format_cost_unit(case)}, by {count} signals"


def _bound_by_tree(case: Case) -> float:
    """Return the lower bound of the time of action that the leaves of the certificate's tree prove; infinite where they
    leave no control."""
    data = case.certificate.get("tree")
    if not isinstance(data, Mapping):
        raise Unchecked("the certificate holds no tree of parts")
    if case.control.functions < case.control.pieces:
        raise Unchecked("the control has fewer functions than pieces, which is not followed")
    entries = listed(data, "constraints")

    def of_leaf(leaf: Mapping[str, Any]) -> list[tuple[float, ConstraintRow]]:
        constraints = []
        for pair in listed(leaf, "multipliers"):
            if not (isinstance(pair, list) and len(pair) == 2 and type(pair[0]) is int and 0 <= pair[0] < len(entries)):
                raise Broken("tree: expected the number of a constraint and its multiplier")
            entry = entries[pair[0]]
            constraints.append({**entry, "multiplier": pair[1]} if isinstance(entry, Mapping) else entry)
        others = {name: leaf.get(name) for name in ("equalities", "late")}
        return weighted(case, {"constraints": constraints, **others})[0]

    return activity.bound_by_tree(case, listed(data, "nodes"), of_leaf)


def _verify_infeasibility(case: Case) -> str:
    """Show that no control is feasible."""
    if case.certificate.get("tree") is not None and case.certificate.get("multipliers") is None:
        if not case.counts or _bound_by_tree(case) < np.inf:
            raise Broken("the leaves of the tree leave some control")
        return "every part of the controls is excluded by multipliers of its own"
    amount = multiplied(case, priced=False)
    if not amount > 0:
        raise Broken(f"the multipliers prove {float(amount.lower()):.3g}, expected a positive number")
    entries = case.certificate["multipliers"]["constraints"]
    constraints_text = "this constraint" if len(entries) == 1 else f"these {len(entries)} constraints together"
    return (
        f"no control meets {constraints_text}: the weighted sum is at least"
        f" {float(amount.lower()):.4g} for every control, it must not be positive"
    )


def _verify_status(case: Case, status: str, tolerance: float | None, claims: list[Finding]) -> str:
    """Show that the status follows from the claims before it."""
    if status == "undecided":
        return "nothing is claimed beyond the figures above"
    kept = [claim for claim in claims if claim.name not in ("cost", "lower bound", *ASIDE)]
    wrong = [claim.name for claim in kept if claim.verdict == "fails"]
    if wrong:
        raise Broken(f"it is {status}, but {', '.join(wrong)} does not hold")
    needed = kept if status == "verified" else [claim for claim in claims if claim.name not in ASIDE]
    if any(claim.verdict == "not checked" for claim in needed):
        raise Unchecked(f"{status} rests on claims that were not checked")
    cost, lower = number(case.certificate, "cost"), number(case.certificate, "lower_bound")
    proven = any(claim.name == "lower bound" and claim.verdict == "holds" for claim in claims)
    if proven and not case.counts and case.certificate.get("multipliers") is not None:
        derived = float(multiplied(case, priced=True).lower())
        if derived > cost + CONTRADICTION * max(1.0, added_up(case)):
            raise Broken(f"no control costs less than {derived!r}, yet one that keeps every constraint costs {cost!r}")
    if status == "verified":
        return f"every constraint is kept; the gap is {relative_gap(case, cost, lower):.2e}"
    if case.price.is_quadratic and not case.counts:
        cost = max(cost, -below(-feedback_of(case).cost()))
    gap = relative_gap(case, cost, lower)
    written = case.certificate.get("gap_tolerance")
    if tolerance is None or written != tolerance:
        raise Broken(f"the gap is to be within {written!r}, the config says {tolerance!r}")
    if not gap <= tolerance + SMALL_GAP:
        raise Broken(f"it is certified, but the gap is {gap:.3g}, more than {tolerance:g}")
    return f"every constraint is kept, and the bounds meet within {gap:.2e}"


def relative_gap(case: Case, cost: float, lower: float) -> float:
    """Return the gap between the cost and the lower bound relative to the larger of their absolute values, or to a
    millionth of what is added up to the cost; 0 where the bounds meet."""
    return 0.0 if cost <= lower else (cost - lower) / max(abs(cost), abs(lower), SMALL_COST * added_up(case))


def added_up(case: Case) -> float:
    """Return the size of the numbers that are added up to the claimed cost. This size is the cost itself, except for
    quadratic costs, whose terms may cancel."""
    cost = number(case.certificate, "cost")
    if case.counts or not case.price.is_quadratic:
        return abs(cost)
    lengths = None if case.charge == "nominal" else cost - case.price.squares(case.pieces)
    return case.price.added(case.pieces, lengths)


def compared(case: Case) -> float:
    """Return the size that the rounding error of a cost is relative to: all products that are added up to it count."""
    return max(added_up(case), 0.0 if case.counts else case.price.terms(case.pieces))


def _verify_witness(case: Case) -> str:
    """Show that the state to which the witness leads violates the constraint by as much as is written."""
    data = case.certificate.get("witness")
    if not isinstance(data, Mapping):
        raise Unchecked("the certificate holds no witness")
    return _verify_violation(case, *witnessed(case, data), data)


def _verify_violation(case: Case, over: arb, slack: float, data: Mapping[str, Any]) -> str:
    """Show that an excess ``over`` is a violation, and agrees with the figure of the witness. The two may differ by a
    millionth of the excess, plus ``slack``, enlarged where many steps are rounded."""
    allowed = excused(case, data, slack)
    if not over > allowed:
        raise Broken(f"it leads to a violation of {float(over):.3g}, up to {allowed:.3g} is none")
    # each step of the state's transition rounds a figure in doubles d + 2 times; the slack stands for 17 roundings
    rounded = slack * max(1.0, len(case.timing.grid) * (case.problem.system.states + 2) / 17.0)
    if abs(float(over) - number(data, "violation")) > 1e-6 * abs(float(over)) + rounded:
        raise Broken(f"a violation of {data.get('violation')!r} is written, {float(over)!r} is derived")
    name, unit = (
        data.get("constraint"),
        _format_row_unit(case, str(data.get("constraint")), numbers(data.get("direction"), "")),
    )
    return f"{name} is exceeded by {float(over.lower()):.6g}{unit} at {_format_time(case, number(data, 'time'))}"


def _format_time(case: Case, time: float) -> str:
    """Return a time in words."""
    return f"t = {time:.6g} {case.problem.names.time}".rstrip()


def _format_row_unit(case: Case, name: str, direction: Array) -> str:
    """Return the unit of the row of a constraint with this normal, after a space; an empty string for a curved set."""
    control_sets = {case.of_control: case.problem.control, STEP: case.problem.control_step}
    shape = control_sets[name] if name in control_sets else None if name == EQUALS else case.window(name).shape
    if shape is not None and shape.halfspaces() is None:
        return ""
    return unit_of_row(direction, case.problem.names, 0 if name in control_sets else case.problem.system.states)
