"""What a certificate claims, each claim derived anew from the problem's data in ball arithmetic."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_core.checker.arithmetic.balls import balls, below
from sparserob_core.checker.claims import activity
from sparserob_core.checker.claims.case import Case, listed, number, numbers, written_policy
from sparserob_core.checker.claims.constraints import bounded, equalities, is_followed
from sparserob_core.checker.claims.duality import Row, before, steps
from sparserob_core.checker.claims.replay import reached
from sparserob_core.checker.claims.window import Window
from sparserob_core.checker.outcome import TOLERANCE, Broken, Finding, Unchecked
from sparserob_core.checker.sets.known import known
from sparserob_core.control.problem.system import VaryingSystem
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat

    from sparserob_core.checker.claims.feedback import FeedbackClaims

PRECISION = 96  # bits, where the numbers of a system are of one size
MOST_PRECISION = 1024
VARYING = 96  # more bits for a tree of products, in each level of which balls grow; half of it shows after ten orbits
FIGURES = 1e-11  # relative to the larger of it and 1: how closely a written figure must agree with the one derived
SMALL_COST = 1e-6  # of what is added up to a cost: a gap is relative to at least so much
# Of what is added up to a cost: so much must agree to `FIGURES` where terms cancel, that is, to 1e-14 of the terms,
# some forty roundings. Ten times smaller, and honest costs of 0 are refused, whose terms were rounded; ten times
# larger, and a cost may be written lower than it is by as much as a gap that counts as closed.
CANCELLED = 1e-3
SMALL_GAP = 1e-11  # what is subtracted from a lower bound for rounding may open a gap that was closed
MOST_MULTIPLIERS = 100_000
ASIDE = ("fewest active", "causal")  # claims that the status does not rest on


def check(case: Case, gap_tolerance: float | None) -> list[Finding]:
    """One verdict per claim of the certificate; nothing that the file says is believed."""
    from flint import ctx

    status = case.certificate.get("status")
    with ctx.workprec(precision_of(case)):
        if type(case.certificate.get("format")) is not int or case.certificate["format"] != 1:
            return [Finding("certificate", "fails", f"its format is {case.certificate.get('format')!r}, expected 1")]
        causal = [judged("causal", lambda: _causal(case))] if "causal" in case.certificate else []
        policy = [judged("policy", lambda: _policy(case))] if "policy" in case.certificate else []
        if status == "infeasible":
            return [*policy, judged("infeasibility", lambda: _infeasible(case)), *causal]
        if status not in ("certified", "verified", "refuted", "undecided"):
            return [Finding("status", "fails", f"it is {status!r}, which claims nothing")]
        claims = [*policy, judged("control", lambda: _control(case)), judged("cost", lambda: _cost(case))]
        claims += [judged("lower bound", lambda: _lower(case))]
        if "fewest_active" in case.certificate:
            claims.append(judged("fewest active", lambda: _fewest(case, str(status))))
        claims += causal
        if status == "refuted":
            return [*claims, judged("violation", lambda: _witness(case))]
        if case.problem.control_step is not None:
            claims.append(judged("control_step", lambda: _changed(case)))
        if case.equalities:
            claims.append(judged("equalities", lambda: _equalities(case)))
        claims += [judged(window.name, lambda window=window: _kept(case, window)) for window in case.windows]  # type: ignore[misc]
        if case.problem.repeat or "repeat" in case.certificate:
            claims.append(judged("repeat", lambda: _repeats(case, {one.name: one.verdict for one in claims})))
        return [*claims, judged("status", lambda: _status(case, str(status), gap_tolerance, claims))]


def derived_bound(case: Case) -> float:
    """The lower bound of the cost that the certificate's multipliers prove, rounded downwards; raises `Unchecked` and
    `Broken` where there is none."""
    from flint import ctx

    with ctx.workprec(precision_of(case)):
        return below(_multiplied(case, priced=True))


def derived_causal_bound(case: Case, data: Mapping[str, Any], priced: bool) -> float:
    """What every causal policy costs at least, by these signals and multipliers, rounded downwards; not ``priced``: by
    how much it misses their sum. Raises `Unchecked` and `Broken` where there is none."""
    from flint import ctx

    from sparserob_core.checker.claims.causal import causal_bound

    with ctx.workprec(precision_of(case)):
        return below(causal_bound(case, data, priced))


def precision_of(case: Case) -> int:
    """Bits of a number. The exponential of a matrix is enclosed in a norm, so that its smallest entries need as many
    more bits as the system's numbers differ by, in the units that the user chose."""
    problem = case.problem
    parameters = problem.system.parameters
    middle = np.zeros((1, 0)) if parameters is None else parameters.interior_point()[None]
    try:
        parts = [part for mode in problem.system.modes for part in mode.matrices(middle)]
    except InputError:  # not finite there
        return PRECISION
    entries = np.concatenate([np.ravel(part) for part in parts]) * problem.horizon
    sizes = np.abs(entries[np.isfinite(entries) & (entries != 0.0)])
    apart = np.log2(max(1.0, sizes.max(initial=1.0))) - np.log2(min(1.0, sizes.min(initial=1.0)))
    spare = VARYING if isinstance(problem.system, VaryingSystem) else 0
    return int(min(PRECISION + spare + np.ceil(apart), MOST_PRECISION))


def judged(name: str, derive: Callable[[], str]) -> Finding:
    """The verdict of a derivation that returns a sentence or raises. Where a number of floats overflows nothing is
    derived: what it is compared with would pass, were it not a number."""
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


def _feedback(case: Case) -> FeedbackClaims:
    """What is derived of a control that answers its measurements."""
    from sparserob_core.checker.claims.feedback import feedback_of

    return feedback_of(case)


def _looped(case: Case) -> bool:
    """Whether the state is followed block by block of what deviates: under feedback, and measurable disturbances."""
    return case.policy is not None or case.measurable


def _policy(case: Case) -> str:
    """What is written of the policy, which bounds and gains are about, must be what the problem's policy says."""
    written = written_policy(case.certificate, case.control.pieces)
    if written.charge.cost != case.charge:
        raise Broken(f"the cost {written.charge.cost} is written, the config asks for {case.charge}")
    different = np.argwhere(written.mask != case.answers)
    if different.size:
        k, j = different[0].tolist()
        does = "is" if written.mask[k, j] else "is not"
        raise Broken(f"that piece {k + 1} answers breakpoint {j + 1} {does} written, which the config's policy denies")
    told = f"answers {int(case.answers.sum())} of {case.control.pieces * (case.control.pieces + 1) // 2} pairs of a"
    told += f" piece and a measurement before it, and is charged {case.charge}"
    # what a component that is not loaded would say is not known: bounds are of the policies that are written
    return f"it {told}" + (", as is written; its own component is not loaded" if case.unloaded else "")


def _kept(case: Case, window: Window) -> str:
    along_rows = is_followed(case, window)
    return bounded(case, window) if along_rows or not _looped(case) else _feedback(case).bounded(window)


def _equalities(case: Case) -> str:
    return _feedback(case).equalities() if _looped(case) else equalities(case)


def _control(case: Case) -> str:
    """Every piece of the control in its set."""
    if case.policy is not None:
        return _feedback(case).control()
    worst, seen = 0.0, set[int]()
    for start, piece in zip(case.control.breakpoints[:-1], case.pieces, strict=True):
        case.clock.check()
        if id(piece) in seen:
            continue
        seen.add(id(piece))
        over, where = known(case.problem.control).excess(piece.entries())
        if over > TOLERANCE:
            raise Broken(f"{where} leaves its set by {over:.3g} of its own unit, from {case.at(float(start))} on")
        worst = max(worst, over)
    return f"{case.control.pieces} pieces in their set" + (f", to {worst:.1e} of its own units" if worst > 0 else "")


def _repeats(case: Case, verdicts: Mapping[str, str]) -> str:
    """That all constraints hold in every period: every final state is an initial one again, and what holds on one
    period, the return and the steps across the seam among it, holds."""
    if case.certificate.get("repeat") is not True or not case.problem.repeat:
        raise Broken("the certificate and the problem differ about whether the plan repeats")
    if case.problem.system.delay > 0.0:
        raise Broken("with a delay the last controls of a period act in the next one")
    fixed, centre = dict(case.equalities), np.asarray(case.problem.initial_state, dtype=float)
    for state in case.single:
        if fixed.get(state) != float(centre[state]):
            name = case.problem.names.state(state)
            raise Broken(f"{name} begins at {float(centre[state])!r}, and does not end there")
    if case.returned is not None:
        _strictly(case, case.returned)
    needed = [name for name, verdict in verdicts.items() if name not in (*ASIDE, "cost", "lower bound")]
    for name in needed:
        if verdicts[name] != "holds":
            raise (Broken if verdicts[name] == "fails" else Unchecked)(f"it rests on {name}, which is {verdicts[name]}")
    back = "every final state is one of the initial states"
    if len(case.single) == centre.size:
        back = "the final state is the initial one, to rounding"
    elif case.single:
        back += ", in " + ", ".join(case.problem.names.state(state) for state in case.single) + " to rounding"
    return f"{back}, so that all constraints hold in every period"


def _strictly(case: Case, window: Window) -> None:
    """That what the proof of the return allows is still in the set of initial states."""
    from flint import arb

    bound = case.problem.initial_set
    assert bound is not None
    mine, flat = window.seen.facets, known(bound).facets
    if mine is None or flat is None:
        return  # what is allowed there is a share of the whole set
    kept = [(c, b) for c, b in flat if not set(np.flatnonzero(c).tolist()) <= {*case.single}]
    if len(mine) != len(kept):
        raise Unchecked("the sides of the set of initial states are not told apart")
    for (c, within), (direction, b), unit in zip(mine, kept, case.units(window).rows.tolist(), strict=True):
        if not np.array_equal(c, direction) or not within + arb(TOLERANCE) * arb(unit) <= b:
            raise Unchecked(
                f"a violation that counts as none leaves the set of initial states along {c.tolist()}: it is too thin"
                " beside the numbers that are added up"
            )


def _changed(case: Case) -> str:
    return _steps(case) if case.policy is None else _feedback(case).steps()


def _steps(case: Case) -> str:
    """Every change of the control from piece to piece in its set."""
    bound, worst = case.problem.control_step, 0.0
    assert bound is not None
    found = steps(case.problem, case.control)
    for k in found:
        case.clock.check()
        last = balls(before(case.problem)) if k == 0 else case.pieces[k - 1].entries()
        next_ = case.pieces[k % case.control.pieces].entries()  # after the last piece comes the first one
        over, where = known(bound).excess([u - v for u, v in zip(next_, last, strict=True)])
        if over > TOLERANCE:
            where = "the change of the control" if where == "it" else f"the change of {where}"
            at = case.at(float(case.control.breakpoints[k]))
            raise Broken(f"{where} leaves its set by {over:.3g} of its own unit, at {at}")
        worst = max(worst, over)
    return f"{len(found)} steps in their set" + (f", to {worst:.1e} of its own units" if worst > 0 else "")


def _cost(case: Case) -> str:
    if case.counts:
        return _counted(case)
    derived = case.price.of(case.pieces) if case.policy is None else _feedback(case).cost()
    _agrees("cost", number(case.certificate, "cost"), derived, CANCELLED * added_up(case))
    return f"J = {float(derived.mid()):.12g}{_effort(case)}"


def _effort(case: Case) -> str:
    """The unit of the cost, with a space before it, where it is known."""
    return f" {unit}" if (unit := case.problem.cost_unit) else ""


def _counted(case: Case) -> str:
    """The time that the control acts, the cost J beside it, and its letters."""
    from flint import arb

    acted, total = activity.acted(case), activity.largest(case)
    _agrees("cost", number(case.certificate, "cost"), arb(acted * total), 0.0)
    derived = case.price.of(case.pieces)
    _agrees("J", number(case.certificate, "J"), derived, CANCELLED * case.price.added(case.pieces))
    if case.letters is not None and not np.isin(case.control.control(case.theta), case.letters).all():
        raise Broken(f"the control takes other values than {list(case.letters)}")
    unit = f" {case.problem.names.time}" if case.problem.names.time else ""
    return f"it acts for {acted * total:.9g}{unit} of {total:.9g}{unit}, J = {float(derived.mid()):.12g}{_effort(case)}"


def _agrees(name: str, written: float, derived: arb, scale: float) -> None:
    from flint import arb

    off = abs(arb(written) - derived)
    if not off <= arb(FIGURES) * arb(scale).max(abs(derived)):
        raise Broken(f"{name}: {written!r} is written, {float(derived.mid())!r} is derived")


def _multiplied(case: Case, priced: bool) -> arb:
    """The bound that the certificate's multipliers give."""
    data = case.certificate.get("multipliers")
    if case.policy is not None:
        return _feedback(case).multiplied(_entries(data), priced, _touched(case, data) if priced else None)
    rows, pieces = _weighted(case, data)
    if not priced:
        return case.duality.bound(rows, pieces, None)
    return case.duality.bound(rows, pieces, case.price, _touched(case, data))


def _entries(data: object) -> Sequence[Any]:
    """The constraints that a certificate gives multipliers of."""
    if data is None:
        raise Unchecked("the certificate holds no multipliers, which this method does not offer")
    if not isinstance(data, Mapping):
        raise Broken("multipliers: expected those of constraints, equalities and pieces")
    entries = listed(data, "constraints")
    if len(entries) > MOST_MULTIPLIERS:
        raise Broken(f"{len(entries)} multipliers are too many to be checked")
    return entries


def _weighted(case: Case, data: object) -> tuple[list[tuple[float, Row]], Any]:
    """Multipliers with their constraints, and those of the control's pieces."""
    from flint import arb

    rows = [_row(case, entry) for entry in _entries(data)]
    assert isinstance(data, Mapping)
    nu = numbers(listed(data, "equalities"), "equalities")
    if nu.shape != (len(case.equalities),):
        raise Broken(f"{nu.size} multipliers of equalities, expected {len(case.equalities)}")
    bound = case.problem.system.parameters
    middle = [] if bound is None else bound.interior_point().tolist()
    for multiplier, (state, value) in zip(nu.tolist(), case.equalities, strict=True):
        row = case.duality.row(
            np.eye(case.problem.system.states)[state], case.problem.horizon, middle, arb(value), disturbed=False
        )
        rows.append((multiplier, row))
    if case.control.functions >= case.control.pieces:  # every piece has a function of its own: nothing to share out
        return rows, None
    pieces, expected = numbers(data.get("pieces"), "pieces"), (case.problem.system.controls, case.control.pieces)
    if pieces.shape != expected:
        raise Broken(f"multipliers of the control's pieces have shape {pieces.shape}, expected {expected}")
    return rows, pieces


def _fewest(case: Case, status: str) -> str:
    """Between what the least share of time lies that an admissible control must act."""
    data = case.certificate["fewest_active"]
    if not isinstance(data, Mapping):
        raise Broken("fewest_active: expected lower, upper and multipliers")
    written, upper = number(data, "lower"), data.get("upper")
    proven = status in ("certified", "verified")
    if (upper is not None) is not proven:
        raise Broken(f"upper is {upper!r} where the status is {status}")
    other = _other(case, data)
    acted = activity.acted(other)
    if proven and abs(number(data, "upper") - acted) > FIGURES:
        raise Broken(f"upper is {upper!r}, the control acts for a share of {acted!r}")
    own = data.get("multipliers")
    if case.counts and case.letters is None:
        derived = _tree(case) / activity.largest(case)
        if not 0.0 <= written <= min(derived, acted if proven else np.inf) + FIGURES:
            raise Broken(f"lower is {written!r}, the leaves prove {derived!r}")
        return _at_least(case, written)
    if own is None and case.problem.cost.blocks and not case.problem.cost.is_quadratic:
        derived = activity.least_of_cost(case, _multiplied(case, priced=True))
    else:
        rows, pieces = _weighted(case, case.certificate.get("multipliers") if own is None else own)
        rows, pieces = activity.shared(case, rows, pieces) if own is None else (rows, pieces)
        derived = activity.least(case, rows, pieces)
    if not 0.0 <= written <= derived + FIGURES or (proven and written > acted + FIGURES):
        raise Broken(f"lower is {written!r}, the multipliers prove {derived!r}")
    least = _at_least(case, written)
    return f"{least}, {'this' if other is case else 'another'} one {acted:.1%}" if proven else least


def _at_least(case: Case, share: float) -> str:
    """How little an admissible control acts, in the words of a run."""
    mean = ", the mean over its channels" if case.problem.system.controls > 1 else ""
    return f"every admissible control acts at least {share:.1%} of the time{mean}"


def _other(case: Case, data: Mapping[str, Any]) -> Case:
    """Another control that the certificate offers, which is admissible too and acts less; or the case itself."""
    if data.get("decision") is None:
        return case
    said = {name: data.get(name) for name in ("decision", "proof")}
    other = replace(case, certificate={**case.certificate, **said})
    _control(other)
    if case.equalities:
        _equalities(other)
    for window in other.windows:
        _kept(other, window)
    return other


def _touched(case: Case, data: object) -> Sequence[arb_mat] | None:
    """The control at which the certificate replaces the cost by its tangent, on every piece."""
    if not (case.price.is_quadratic or any(len(block) > 1 for block in case.price.blocks)):
        return None
    said = data.get("tangent") if isinstance(data, Mapping) else None
    at, expected = numbers(said, "tangent"), (case.problem.system.controls, case.control.functions)
    if at.shape != expected:
        raise Broken(f"the tangent's control has shape {at.shape}, expected {expected}")
    case.price.convex()
    return case.on_pieces(at)


def _row(case: Case, entry: object) -> tuple[float, Row]:
    """A multiplier and its constraint, which must be one of the problem's."""
    case.clock.check()
    if not isinstance(entry, Mapping):
        raise Broken("multipliers: expected a constraint, a time, a parameter, a direction and a number each")
    name = str(entry.get("constraint"))
    direction, time, y = (
        numbers(entry.get("direction"), f"{name}: direction"),
        number(entry, "time"),
        number(entry, "multiplier"),
    )
    if not y > 0:
        raise Broken(f"a multiplier of {name} is {y!r}, expected a positive number")
    if name == case.of_control and not any(window.name == name for window in case.windows):
        _sized(direction, case.problem.system.controls, name)
        return y, case.duality.control_row(direction, time)
    if name == "control_step" and not any(window.name == name for window in case.windows):
        _sized(direction, case.problem.system.controls, name)
        return y, case.duality.step_row(direction, time)
    window, parameter = case.window(name), numbers(entry.get("parameter"), f"{name}: parameter")
    _sized(direction, window.shape.dimension, name)
    if not window.start <= time <= window.stop:
        raise Broken(f"{name}: t = {time!r} is not within {window.start:g} to {window.stop:g}")
    _sized(parameter, case.problem.system.parameter_count, name)
    if case.problem.system.parameters is not None and not known(case.problem.system.parameters).contains(parameter):
        raise Broken(f"{name}: the parameter {parameter.tolist()} is not shown to be in its set")
    key = name, time, tuple(direction.tolist()), tuple(parameter.tolist()), repr(entry.get("piece"))
    if key in case.rows:
        return y, case.rows[key]
    c, gain = window.split(direction)
    limit = window.limit(direction, time)
    row = case.duality.row(c, time, parameter.tolist(), limit, disturbed=not case.measurable)
    if case.measurable:
        row = replace(row, constant=_feedback(case).disturbed(c, time, limit))
    row = replace(row, sizes=None if case.execution is None else case.execution.least(c, time))
    if window.is_mixed:
        piece = _piece(case, window, entry, time)
        row.slope[piece] = [a + balls([g])[0] for a, g in zip(row.slope[piece], gain, strict=True)]
    case.rows[key] = row
    return y, row


def _piece(case: Case, window: Window, entry: Mapping[str, Any], time: float) -> int:
    """The piece of the control that a mixed constraint speaks of."""
    piece = entry.get("piece")
    if not isinstance(piece, int) or isinstance(piece, bool):
        raise Broken(f"{window.name}: piece is {piece!r}, expected the number of a piece of the control")
    window.meets(case.control.breakpoints.tolist(), piece, time)
    return piece


def _sized(vector: Array, size: int, name: str) -> None:
    if vector.shape != (size,):
        raise Broken(f"{name}: {vector.size} numbers where {size} are expected")


def _lower(case: Case) -> str:
    if case.counts:
        written, least = number(case.certificate, "lower_bound"), _tree(case)
        if not written <= least + FIGURES * max(1.0, abs(least)):
            raise Broken(f"{written!r} is written, the leaves prove {least!r}")
        return f"no control of these acts for less than {written:.9g} {case.problem.names.time}".rstrip()
    written, derived = number(case.certificate, "lower_bound"), _multiplied(case, priced=True)
    if written <= 0.0:  # absolute values, lengths and positive semidefinite squares: no multiplier is needed for that
        return f"no control costs less than {written:.12g}{_effort(case)}, for no term of the cost is negative"
    if not derived >= written:
        raise Broken(f"{written!r} is written, the multipliers prove {float(derived.lower())!r}")
    return f"no control costs less than {written:.12g}{_effort(case)}" + (
        f" (the multipliers prove {float(derived.lower()):.12g})"
        if not derived - written < FIGURES * max(1.0, abs(written))
        else ""
    )


def _causal(case: Case) -> str:
    """The bound against every causal policy."""
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
    return f"no causal policy costs less than {written:.9g}{_effort(case)}, by {count} signals"


def _tree(case: Case) -> float:
    """What the leaves of the certificate's tree prove of the time that a control acts."""
    data = case.certificate.get("tree")
    if not isinstance(data, Mapping):
        raise Unchecked("the certificate holds no tree of parts")
    if case.control.functions < case.control.pieces:
        raise Unchecked("the control has fewer functions than pieces, which is not followed")
    known = listed(data, "constraints")

    def weighted(leaf: Mapping[str, Any]) -> list[tuple[float, Row]]:
        constraints = []
        for pair in listed(leaf, "multipliers"):
            if not (isinstance(pair, list) and len(pair) == 2 and type(pair[0]) is int and 0 <= pair[0] < len(known)):
                raise Broken("tree: expected the number of a constraint and its multiplier")
            said = known[pair[0]]
            constraints.append({**said, "multiplier": pair[1]} if isinstance(said, Mapping) else said)
        return _weighted(case, {"constraints": constraints, "equalities": leaf.get("equalities")})[0]

    return activity.proven(case, listed(data, "nodes"), weighted)


def _infeasible(case: Case) -> str:
    if case.certificate.get("tree") is not None and case.certificate.get("multipliers") is None:
        if not case.counts or _tree(case) < np.inf:
            raise Broken("the leaves of the tree leave some control")
        return "every part of the controls is excluded by multipliers of its own"
    amount = _multiplied(case, priced=False)
    if not amount > 0:
        raise Broken(f"the multipliers prove {float(amount.lower()):.3g}, expected a positive number")
    entries = case.certificate["multipliers"]["constraints"]
    which = "this constraint" if len(entries) == 1 else f"these {len(entries)} constraints together"
    return (
        f"no control meets {which}: the weighted sum is at least"
        f" {float(amount.lower()):.4g} for every control, it must not be positive"
    )


def _status(case: Case, status: str, tolerance: float | None, claims: list[Finding]) -> str:
    """The status must follow from the claims before it."""
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
    gap = relative_gap(case, cost, lower)
    if status == "verified":
        return f"every constraint is kept; the gap is {gap:.2e}"
    written = case.certificate.get("gap_tolerance")
    if tolerance is None or written != tolerance:
        raise Broken(f"the gap is to be within {written!r}, the config says {tolerance!r}")
    if not gap <= tolerance + SMALL_GAP:
        raise Broken(f"it is certified, but the gap is {gap:.3g}, more than {tolerance:g}")
    return f"every constraint is kept, and the bounds meet within {gap:.2e}"


def relative_gap(case: Case, cost: float, lower: float) -> float:
    """The gap relative to the larger of the two bounds, or to a millionth of what is added up to the cost where that is
    more; 0 where the bounds meet."""
    return 0.0 if cost <= lower else (cost - lower) / max(abs(cost), abs(lower), SMALL_COST * added_up(case))


def added_up(case: Case) -> float:
    """What is added up to the cost that is claimed: the cost itself, but where the quadratic terms of one cancel."""
    cost = number(case.certificate, "cost")
    if case.counts or not case.price.is_quadratic:
        return abs(cost)
    other = None if case.charge == "nominal" else cost - case.price.squares(case.pieces)
    return case.price.added(case.pieces, other)


def largest_cost(case: Case) -> float:
    """The largest cost that a control may have, of which earlier versions made the gap a share."""
    return activity.largest(case) if case.counts else case.price.largest


def _witness(case: Case) -> str:
    """The state that the witness leads to, and by how much it leaves the constraint."""
    data = case.certificate.get("witness")
    if not isinstance(data, Mapping):
        raise Unchecked("the certificate holds no witness")
    if case.policy is not None:
        return _exceeded(case, *_feedback(case).driven(data), data)
    window, time = case.window(str(data.get("constraint"))), number(data, "time")
    direction, parameter = (numbers(data.get(key), key) for key in ("direction", "parameter"))
    _sized(direction, window.shape.dimension, window.name)
    _sized(parameter, case.problem.system.parameter_count, window.name)
    if not window.start <= time <= window.stop:
        raise Broken(f"t = {time!r} is not within {window.start:g} to {window.stop:g}")
    if case.problem.system.parameters is not None and not known(case.problem.system.parameters).contains(parameter):
        raise Broken(f"the parameter {parameter.tolist()} is not shown to be in its set")
    height = window.limit(direction, time)
    if case.measurable:  # the worst is no signal on pieces: how far all of them reach is enclosed instead
        k = _piece(case, window, data, time) if window.is_mixed else None
        over = _feedback(case).farthest(*window.split(direction), time, k) - height
        return _exceeded(case, over, case.units(window).slack(direction, height), data)
    state = reached(case, time, parameter, data.get("disturbance"), data.get("deviation"))
    if window.is_mixed:
        state = state + case.pieces[_piece(case, window, data, time)].entries()
    over = sum((balls([c])[0] * x for c, x in zip(direction, state, strict=True)), -height)
    if case.execution is not None:
        low, high = case.execution.added(window.split(direction)[0], time)
        over = over + balls([low])[0].union(balls([high])[0])
    return _exceeded(case, over, case.units(window).slack(direction, height), data)


def _exceeded(case: Case, over: arb, slack: float, data: Mapping[str, Any]) -> str:
    """A constraint is exceeded by ``over``, up to ``slack`` of which is none, as the witness says."""
    if not over > slack:
        raise Broken(f"it leads to a violation of {float(over.mid()):.3g}, up to {slack:.3g} is none")
    if abs(float(over.mid()) - number(data, "violation")) > 1e-6 * abs(float(over.mid())) + slack:
        raise Broken(f"a violation of {data.get('violation')!r} is written, {float(over.mid())!r} is derived")
    name, unit = data.get("constraint"), case.measured(str(data.get("constraint")), numbers(data.get("direction"), ""))
    return f"{name} is exceeded by {float(over.lower()):.6g}{unit} at {case.at(number(data, 'time'))}"
