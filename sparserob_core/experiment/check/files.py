"""The comparison of the other files of a run with its certificate; entries that cannot be compared are named."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, final

import numpy as np

from sparserob_core.checker.claims.case import shaped
from sparserob_core.checker.outcome import CANCELLED, Broken, Finding, Unchecked, Verdict
from sparserob_core.checker.outcome import FIGURES as AGREED
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.shape import excess
from sparserob_core.errors import InputError
from sparserob_core.experiment.directory.finished import ANSWERS, StoredRun
from sparserob_core.experiment.directory.sparsity import sparsity
from sparserob_core.quantities import statistics
from sparserob_core.sip.result import Result

if TYPE_CHECKING:
    from sparserob_core.checker.claims.case import Case
    from sparserob_core.control.sets.sets import ConvexSet
    from sparserob_core.experiment.config.load import Loaded
    from sparserob_core.sip.convex_set import Array

DERIVED_TOLERANCE = 1e-12  # relative error that is allowed to numbers that are computed anew
# The same for numbers with rounding errors: the largest cost, points that were moved into their sets
RECOMPUTED_TOLERANCE = 1e-9
READ = {"config.yaml", "certificate.json", "result.json", "solution.npz"}


@final
@dataclass
class Compared:
    """The verdicts on the files, and the names of the entries that were not compared, by file."""

    claims: list[Finding] = field(default_factory=list)
    left: dict[str, list[str]] = field(default_factory=dict)

    @property
    def not_compared(self) -> tuple[str, ...]:
        """The entries that were not compared, as ``file`` or ``file: names``."""
        return tuple(f"{file}: {', '.join(names)}" if names else file for file, names in self.left.items())


def compared(stored: StoredRun, loaded: Loaded, case: Case, summary: Mapping[str, Any]) -> Compared:
    """Compare ``result.json`` and ``solution.npz`` with the certificate and the config.

    Parameters
    ----------
    stored : StoredRun
        The files of the run.
    loaded : Loaded
        Its config.
    case : Case
        Its problem and its certificate, as the checker has them.
    summary : mapping
        The contents of ``result.json``.

    Returns
    -------
    Compared
        The verdicts. Other files are not read, only named.
    """
    from flint import ctx

    from sparserob_core.checker.claims.claims import precision_of

    with ctx.workprec(precision_of(case)):
        return _compare_files(stored, loaded, case, summary)


def compare_program(stored: StoredRun, data: Mapping[str, Any], summary: Mapping[str, Any], n: int) -> Compared:
    """Compare ``result.json`` and ``solution.npz`` of a stated program with its certificate ``data``.

    ``n`` is the number of entries of its decision.
    """
    comparison = Compared()
    claims = [name for name, entry in statistics(Result).items() if entry.certified == name]
    different = [
        f"{name} is {summary.get(name)!r}, the certificate says {data.get(name)!r}"
        for name in claims
        if summary.get(name) != data.get(name)
    ]
    text = "status, cost and lower bound are those of the certificate"
    comparison.claims.append(Finding("result.json", "fails" if different else "holds", "; ".join(different) or text))
    decision = stored.solution.get("decision", np.zeros(0))
    try:
        written = np.zeros(0) if data.get("decision") is None else shaped(data, "decision", (n,))
    except Broken:  # the claims about it say so
        written = np.full(n, np.nan)
    is_same = decision.shape == written.shape and bool((decision == written).all())
    verdict: Verdict = "holds" if is_same else "fails"
    text = f"the decision is {'that' if is_same else 'not that'} of the certificate"
    comparison.claims.append(Finding("solution.npz", verdict, text))
    comparison.left |= {path.name: [] for path in sorted(stored.directory.iterdir()) if path.name not in READ}
    return comparison


def _compare_files(stored: StoredRun, loaded: Loaded, case: Case, summary: Mapping[str, Any]) -> Compared:
    comparison = Compared()
    for name, (different, agrees, uncompared) in (
        ("result.json", _compare_result(loaded, case, summary)),
        ("solution.npz", _compare_solution(stored, case)),
    ):
        comparison.claims.append(Finding(name, "fails" if different else "holds", "; ".join(different) or agrees))
        if uncompared:
            comparison.left[name] = uncompared
    unread = sorted(_list_unread(case))
    if unread:
        comparison.left["certificate.json"] = unread
    comparison.left |= {path.name: [] for path in sorted(stored.directory.iterdir()) if path.name not in READ}
    return comparison


ALWAYS = {"format", "config", "status", "multipliers"}
FIGURED = ALWAYS | {"cost", "lower_bound", "decision", "fewest_active", "J", "tree"}
CERTIFICATE = {
    "certified": FIGURED | {"gap_tolerance", "proof"},
    "verified": FIGURED | {"proof"},
    "undecided": FIGURED | {"proof"},
    "refuted": FIGURED | {"witness"},
    "infeasible": ALWAYS | {"lower_bound", "tree"},
}
"""The keys of a certificate that are checked, by its status."""
SOMETIMES = frozenset[str]().union(*CERTIFICATE.values())
NOTHING: tuple[object, ...] = (None, {}, [])
MULTIPLIER = {"constraint", "time", "parameter", "direction", "multiplier"}
CELLS = {"tolerance", "lower", "upper"}
WITNESS = {"constraint", "time", "parameter", "direction", "disturbance", "violation"}
DEVIATION = {"deviation"}
"""Keys of a witness, and of a multiplier under feedback, where the initial states are a set."""
NOISE = {"noise"}
"""Keys of both, where a policy measures outputs with a noise."""


def _list_unread(case: Case) -> set[str]:
    """Return the names ``key.key`` of the entries of a certificate on which none of its claims rests."""
    data, measured = case.certificate, case.problem.measurements
    noisy = case.answering and measured is not None and measured.noise is not None
    read = CERTIFICATE.get(str(data.get("status")), FIGURED)
    read = read | {*ANSWERS, "causal", "policy"} if case.answering else read
    unread = {name for name, value in data.items() if name not in read and not (name in SOMETIMES and value in NOTHING)}
    mixed_windows = {window.name for window in case.windows if window.is_mixed}
    proof, witness, fewest = (data.get(name) for name in ("proof", "witness", "fewest_active"))
    of_activity = fewest.get("multipliers") if isinstance(fewest, Mapping) else None
    unread |= _list_extra_keys("fewest_active", fewest, {"lower", "upper", "multipliers", "decision", "proof"})
    causal, policy = (data.get(name) if case.answering else None for name in ("causal", "policy"))
    unread |= _list_extra_keys("policy", policy, {"cost", "answers"})
    hidden = {"outputs", "initial_states"} if noisy else set()
    unread |= _list_extra_keys("causal", causal, {"lower_bound", "signals", "multipliers", "shares"} | hidden)
    rows = causal.get("multipliers") if isinstance(causal, Mapping) else None
    for entry in rows if isinstance(rows, list) else []:
        unread |= _list_extra_keys("causal.multipliers", entry, (MULTIPLIER - {"parameter"}) | {"signal"})
    for multipliers in (data.get("multipliers"), of_activity):
        if not isinstance(multipliers, Mapping):
            continue
        is_tangent_read = multipliers is not of_activity and not case.problem.cost.is_linear
        is_tangent_read = is_tangent_read or multipliers.get("tangent") is None
        unused = case.control.functions >= case.control.pieces and multipliers.get("pieces") is not None
        multiplier_keys = {
            "constraints",
            "equalities",
            *(() if unused else ("pieces",)),
            *(("tangent",) if is_tangent_read else ()),
            *(("late",) if case.problem.jitter else ()),
        }
        multiplier_keys |= (
            {"norms"} if multipliers is not of_activity and case.problem.cost.group is not None else set()
        )
        unread |= _list_extra_keys("multipliers", multipliers, multiplier_keys)
        entries = multipliers.get("constraints")
        for entry in entries if isinstance(entries, list) else []:
            is_mixed = isinstance(entry, Mapping) and str(entry.get("constraint")) in mixed_windows
            extra_keys = ({"piece"} if is_mixed else set()) | ({"disturbance"} if case.answering else set())
            extra_keys |= DEVIATION if case.answering and case.problem.initial_set is not None else set()
            extra_keys |= NOISE if noisy else set()
            unread |= _list_extra_keys("multipliers.constraints", entry, MULTIPLIER | extra_keys)
            unread |= {"multipliers.constraints.parameter"} if _has_unused_parameter(case, entry) else set()
    if "proof" in read and isinstance(proof, Mapping):
        shapes = {window.name: window.shape for window in case.windows}
        unread |= _list_extra_keys("proof", proof, set(shapes))
        for name, shape in shapes.items():
            unread |= _list_extra_keys(
                f"proof.{name}", proof.get(name), CELLS if _is_flat(shape) else CELLS | {"normals"}
            )
    witness_keys = (
        WITNESS | (DEVIATION if case.problem.initial_set is not None else set()) | (NOISE if noisy else set())
    )
    is_mixed = isinstance(witness, Mapping) and str(witness.get("constraint")) in mixed_windows
    witness_keys = witness_keys | {"piece"} if is_mixed else witness_keys
    witness_keys = witness_keys - {"disturbance", *DEVIATION} if case.measurable else witness_keys
    return unread | (_list_extra_keys("witness", witness, witness_keys) if "witness" in read else set())


def _list_extra_keys(name: str, data: object, read: set[str]) -> set[str]:
    return {f"{name}.{key}" for key in data if key not in read} if isinstance(data, Mapping) else set()


def _has_unused_parameter(case: Case, entry: object) -> bool:
    """Return whether a multiplier of the set of controls, or of their steps, has a parameter.

    No parameter changes these sets, so that the entry means nothing.
    """
    if not isinstance(entry, Mapping) or entry.get("constraint") not in (case.of_control, "control_step"):
        return False
    has_no_window = not any(window.name == entry["constraint"] for window in case.windows)
    return has_no_window and bool(entry.get("parameter"))


def _is_flat(shape: ConvexSet) -> bool:
    """Return whether the directions of a set follow from the set itself; those of a certificate are then not read."""
    try:
        return known(shape).facets is not None
    except Unchecked:
        return True


Verdicts = tuple[list[str], str, list[str]]
"""The differences, the sentence where there are none, and the names of entries that were not compared."""


def _compare_result(loaded: Loaded, case: Case, summary: Mapping[str, Any], kind: type[Result] = Result) -> Verdicts:
    """Compare ``result.json`` key by key; ``kind`` is the class of the result."""
    from sparserob_core.checker.outcome import Unchecked

    status = case.certificate.get("status")
    expected_values: dict[str, tuple[object, ...]] = {
        **{
            name: (case.certificate.get(entry.certified),)
            for name, entry in statistics(kind).items()
            if entry.certified
        },
        "config": (case.certificate.get("config"),),
        **({"cost": (None,)} if status == "infeasible" else {}),
        "upper_bound": {
            "infeasible": (None,),
            "refuted": (None,),
            "undecided": (None, case.certificate.get("cost")),
        }.get(str(status), (case.certificate.get("cost"),)),
        "J": (case.certificate.get("J"),),
        **_list_causal_values(case),
        "seed": (loaded.config.seed,),
        "title": (loaded.config.title, loaded.config.title or summary.get("title")),
    }
    different = [
        f"{name} is {summary.get(name)!r}, not {' or '.join(dict.fromkeys(map(repr, values)))}"
        for name, values in expected_values.items()
        if not any(_is_equal(summary.get(name), value) for value in values)
    ]
    uncompared, compared_names = [], set(expected_values)
    for name, compare in COMPARED.items():
        try:
            verdict = compare(case, summary)
        except Unchecked:  # the entry rests on a set of a kind that the checker does not know
            verdict = None
        except Broken as error:  # the certificate lacks the numbers from which the entry follows
            verdict = [f"{name}: {error}"]
        if verdict is None:
            uncompared += [name] if name in summary else []
        else:
            different += verdict
        compared_names.add(name)
    uncompared += [name for name in summary if name not in compared_names]
    for name, read in (("worst", WORST), ("sparsity", SPARSITY)):
        uncompared += sorted(_list_extra_keys(name, summary.get(name), read)) if name not in uncompared else []
    share = None if different or "sparsity" in uncompared else summary["sparsity"]["active_fraction"]
    channel_note = ", in at least one channel" if case.problem.system.controls > 1 else ""
    acts = "" if share is None else f"; its control acts {share:.1%} of the time{channel_note}"
    return different, f"it says what the certificate says{acts}", uncompared


def _list_causal_values(case: Case) -> dict[str, tuple[object, ...]]:
    """Return the values that ``result.json`` may have for causal policies."""
    if not case.answering:
        return {}
    claimed = case.certificate.get("causal")
    lower = claimed.get("lower_bound") if isinstance(claimed, Mapping) else None
    none = isinstance(claimed, Mapping) and lower is None
    least = (lower,) if claimed is not None else (None, 0.0)  # no cost is negative: the bound 0 needs no proof
    return {"causal_lower_bound": least, "causal_infeasible": (none, *(() if none else (None,)))}


def _compare_gap(case: Case, summary: Mapping[str, Any]) -> list[str] | None:
    """Compare the gap with its definition, or with that of earlier versions."""
    from sparserob_core.checker.claims.claims import relative_gap

    if case.certificate.get("status") not in ("certified", "verified"):
        return None
    cost, lower, gap = (summary.get(name) for name in ("cost", "lower_bound", "gap"))
    if not (isinstance(cost, float) and isinstance(lower, float) and isinstance(gap, float)):
        return ["cost, lower_bound and gap are no numbers"]
    derived, earlier = relative_gap(case, cost, lower), (cost - lower) / max(1.0, abs(cost))
    close = any(abs(gap - value) <= DERIVED_TOLERANCE + 1e-6 * abs(value) for value in (derived, earlier))
    return [] if close else [f"gap is {gap!r}, not {derived!r}"]


def _compare_cost_scale(case: Case, summary: Mapping[str, Any]) -> list[str] | None:
    """Compare the size of the terms that are added up to the cost."""
    if "cost_scale" not in summary:
        return None
    from sparserob_core.checker.claims.claims import added_up, compared

    cost_scale, has_decision = summary["cost_scale"], case.certificate.get("decision") is not None
    derived = added_up(case) if has_decision else 0.0
    rounded = AGREED * CANCELLED * compared(case) if has_decision else 0.0
    is_near = isinstance(cost_scale, float) and abs(cost_scale - derived) <= rounded
    agrees = is_near or _is_close(cost_scale, derived, RECOMPUTED_TOLERANCE)
    return [] if agrees else [f"cost_scale is {cost_scale!r}, not {derived!r}"]


def _compare_sparsity(case: Case, summary: Mapping[str, Any]) -> list[str] | None:
    """Compare the share of time for which the certificate's control acts, and the number of its switches."""
    entry = summary.get("sparsity")
    if not isinstance(entry, Mapping):
        return ["sparsity is no mapping"]
    derived: dict[str, Any] = {"active_fraction": None, "switches": None}
    if entry.get("channels", case.problem.system.controls) != case.problem.system.controls:
        return [f"sparsity: channels is {entry['channels']!r}, not {case.problem.system.controls}"]
    fewest, claimed = entry.get("fewest_active"), case.certificate.get("fewest_active")
    if isinstance(claimed, Mapping):
        claimed = {name: claimed.get(name) for name in ("lower", "upper")}
    if fewest != claimed:
        return [f"sparsity: fewest_active is {fewest!r}, the certificate says {claimed!r}"]
    if case.certificate.get("decision") is not None and case.certificate.get("status") != "infeasible":
        try:
            derived = asdict(sparsity(_estimate_control(case), case.control.breakpoints))
        except Broken as error:
            return [f"sparsity: {error}"]
    elif case.certificate.get("status") == "infeasible":
        return None
    return [
        f"sparsity: {name} is {entry.get(name)!r}, not {value!r}"
        for name, value in derived.items()
        if not _is_close(entry.get(name), value)
    ]


def _compare_value(case: Case, summary: Mapping[str, Any]) -> list[str] | None:
    """Compare the value of the regularised problem with the cost, where there is no regulariser.

    A difference within the rounding errors of a cost that is not small is allowed. With a regulariser the value is not
    computed anew.
    """
    if summary.get("epsilon") != 0.0 or case.certificate.get("status") == "infeasible":
        return None
    if case.certificate.get("decision") is None:
        return [] if summary.get("value") is None else [f"value is {summary['value']!r}, and there is no decision"]
    from sparserob_core.checker.claims.claims import compared

    value, cost = summary.get("value"), summary.get("cost")
    slack = DERIVED_TOLERANCE * CANCELLED * compared(case)
    near = isinstance(value, float) and isinstance(cost, float) and abs(value - cost) <= slack
    return [] if near or _is_close(value, cost) else [f"value is {value!r} without a regulariser, the cost {cost!r}"]


def _compare_worst(case: Case, summary: Mapping[str, Any]) -> list[str] | None:
    """Compare the worst constraint.

    It must be that of the witness. Without one it is computed anew at its time and parameter, where its set is flat.
    """
    entry, status = summary.get("worst"), case.certificate.get("status")
    if not isinstance(entry, Mapping):
        return ["worst is no mapping"]
    if status == "refuted":
        witness = case.certificate.get("witness")
        if not isinstance(witness, Mapping):
            return None
        names = [
            name for name in ("violation", "constraint", "time") if not _is_close(entry.get(name), witness.get(name))
        ]
        if entry.get("parameter") and not _is_close_point(entry["parameter"], witness.get("parameter")):
            names.append("parameter")
        names += [] if _is_witness_initial_state(case, entry, witness) else ["initial_state"]
        return [f"worst: {name} is {entry.get(name)!r}, that of the witness {witness.get(name)!r}" for name in names]
    if status not in ("certified", "verified"):
        return None
    if entry.get("constraint") in (None, ""):  # a problem without constraints that can be violated
        return [] if entry.get("violation") is None and not case.windows else ["worst: no constraint is named"]
    try:
        return _compare_worst_violation(case, entry)
    except Unchecked:
        return None
    except Broken as error:
        return [f"worst: {error}"]


def _measure_excess(bound: ConvexSet, initial_state: Array, centre: Array) -> float:
    """Return how far an initial state lies outside a set of deviations from a centre, in the set's own unit.

    The rounding error of the sum of deviation and centre is not counted.
    """
    from sparserob_core.checker.arithmetic.balls import balls

    shape, deviation = known(bound), initial_state - centre
    rounded = np.finfo(float).eps * (np.abs(initial_state) + np.abs(centre))
    if shape.facets is not None:
        return excess(shape, balls(deviation), lambda c: balls([-float(np.abs(c) @ rounded)])[0])[0]
    distance = np.maximum(np.abs(deviation - shape.centre) - rounded, 0.0)
    return excess(shape, balls(shape.centre + np.copysign(distance, deviation - shape.centre)))[0]


def _compare_worst_violation(case: Case, said: Mapping[str, Any]) -> list[str]:
    """Compare the worst violation with that of the worst uncertainty.

    Where there are several initial states, the one that is named must attain it too.
    """
    from sparserob_core.checker.claims.case import numbers
    from sparserob_core.checker.claims.replay import exceeded

    violations = [("", *exceeded(case, said))]
    if case.problem.initial_set is not None and not case.answering:
        initial_state = numbers(_complete_state(case, said.get("initial_state")), "initial_state")
        centre = np.asarray(case.problem.initial_state)
        if (
            initial_state.shape != centre.shape
            or _measure_excess(case.problem.initial_set, initial_state, centre) > RECOMPUTED_TOLERANCE
        ):
            return [f"worst: {initial_state.tolist()} is no initial state"]
        violations.append((f" from {initial_state.tolist()}", *exceeded(case, said, initial_state)))
    elif "initial_state" in said:
        return ["worst: an initial state is named where there is one only, or none is known"]
    violation = said["violation"]
    return [
        f"worst: the violation is {violation!r}, derived are {', '.join(f'{value:.3g}' for value in values)}{origin}"
        for origin, values, slack in violations
        if not any(abs(violation - value) <= 1e-6 * abs(value) + slack for value in values)
    ]


def _is_witness_initial_state(case: Case, said: Mapping[str, Any], witness: Mapping[str, Any]) -> bool:
    """Return whether the worst initial state in ``result.json`` is that of the witness."""
    if case.problem.initial_set is None or (case.answering and "initial_state" not in said):
        return "initial_state" not in said
    deviation = witness.get("deviation")
    if not isinstance(deviation, list) or not all(isinstance(coordinate, int | float) for coordinate in deviation):
        return False
    centre = np.asarray(case.problem.initial_state, dtype=float)
    initial_state = _complete_state(case, said.get("initial_state"))
    return len(deviation) == centre.size and _is_close_point(initial_state, (centre + deviation).tolist())


def _complete_state(case: Case, said: object) -> object:
    """Return an initial state of the user's coordinates together with those that integrals and parameters add.

    The added ones are known. A state that has all coordinates is returned as it is.
    """
    initial_state = np.asarray(case.problem.initial_state, dtype=float)
    if not isinstance(said, list) or len(said) != case.original_problem.system.states:
        return said
    return [*said, *initial_state[len(said) :].tolist()]


def _is_close_point(said: object, point: object) -> bool:
    """Return whether two points agree, where one of them was moved into its set against rounding errors."""
    if not (isinstance(said, list) and isinstance(point, list) and len(said) == len(point)):
        return False
    return all(_is_close(a, b, RECOMPUTED_TOLERANCE) for a, b in zip(said, point, strict=True))


WORST = {"violation", "constraint", "time", "parameter", "initial_state"}
SPARSITY = {"active_fraction", "switches", "channels", "fewest_active"}


def _compare_cost_terms(case: Case, summary: Mapping[str, Any]) -> list[str] | None:
    """Compare the terms of the cost, in words."""
    words = case.problem.cost.words()
    entry = summary.get("cost_of", words)
    return [] if entry == words else [f"cost_of is {entry!r}, not {words!r}"]


def _compare_units(case: Case, summary: Mapping[str, Any]) -> list[str]:
    """Compare the units with those that the config names."""
    entry, names = summary.get("units") or {}, case.problem.names
    known_units = {"", *names.state_units, *names.control_units}
    rows = entry.get("rows") if isinstance(entry, Mapping) else None
    if not isinstance(entry, Mapping) or not isinstance(rows, Mapping | None):
        return ["units is no mapping with rows"]
    written_units = [
        entry.get("worst", ""),
        *(unit for row in (rows or {}).values() for unit in (row if isinstance(row, list) else [row])),
    ]
    different = [unit for unit in written_units if not isinstance(unit, str) or unit not in known_units]
    wrong = [f"units: {unit} is none of the config's" for unit in dict.fromkeys(map(repr, different))]
    effort = case.problem.cost_unit
    cost = names.time if case.counts else effort
    user_states, units = case.original_problem.system.states, list(names.state_units)
    for key, unit in (("time", names.time), ("states", units[:user_states]), ("cost", cost), ("J", effort)):
        allowed = (unit, units) if key == "states" else (unit,)  # earlier versions wrote the units of added states too
        wrong += [f"units: {key} is {entry[key]!r}, not {unit!r}"] if key in entry and entry[key] not in allowed else []
    return wrong


def _compare_parameters(case: Case, summary: Mapping[str, Any]) -> list[str] | None:
    """Compare the names of the uncertain parameters, in the order of their values."""
    names = [] if case.problem.system.parameters is None else list(case.problem.system.names)
    entry = summary.get("parameters", names)
    return [] if entry == names else [f"parameters are {entry!r}, not {names!r}"]


COMPARED: dict[str, Callable[[Case, Mapping[str, Any]], list[str] | None]] = {
    "gap": _compare_gap,
    "cost_scale": _compare_cost_scale,
    "cost_of": _compare_cost_terms,
    "sparsity": _compare_sparsity,
    "value": _compare_value,
    "worst": _compare_worst,
    "units": _compare_units,
    "parameters": _compare_parameters,
}


def _is_equal(said: object, value: object) -> bool:
    """Return whether two entries of JSON are equal; a truth value is no number."""
    return said == value and isinstance(said, bool) is isinstance(value, bool)


def _is_close(said: object, value: object, figures: float = DERIVED_TOLERANCE) -> bool:
    """Return whether two entries of JSON agree, numbers up to rounding errors."""
    numbers = [entry for entry in (said, value) if isinstance(entry, int | float) and not isinstance(entry, bool)]
    if len(numbers) == 2:
        return abs(numbers[0] - numbers[1]) <= figures * max(abs(numbers[0]), abs(numbers[1]))
    return type(said) is type(value) and said == value


STORED = ("theta", "control", "breakpoints", "decision")


def _count_size_bounds(case: Case) -> int:
    """Return how many bounds of the control's sizes follow its coefficients in a decision."""
    m, pieces = case.problem.system.controls, case.control.pieces
    return 0 if case.problem.delivery is None else m * (2 * pieces - 1 if case.problem.jitter else pieces)


def _estimate_control(case: Case) -> Array:
    """Return the control ``(m, K)`` of a certificate on every piece; under feedback the nominal one."""
    if not case.inner.acts:
        return case.control.control(case.theta)
    return np.array([[float(u) for u in piece.entries()] for piece in case.pieces]).T


def _compare_solution(stored: StoredRun, case: Case) -> Verdicts:
    """Compare the control in ``solution.npz`` with that of the certificate."""
    if case.certificate.get("decision") is None:
        return [], "there is no decision", []
    try:
        arrays = stored.solution
        theta, control, breakpoints, flat = (arrays[name] for name in STORED)
        decision = np.array(case.certificate["decision"], dtype=float)
        size = case.control.summands(decision)
        answered = ["gains"] if case.answering else []
        answered += ["observer"] if case.answering and case.problem.measurements is not None else []
        answered += ["prestabilise"] if case.inner.acts else []
        expected = _estimate_control(case)
        if case.inner.acts:  # a sum whose parts may cancel: as accurate as controls are large
            largest = case.problem.control.reach(np.eye(len(decision)))
            size = np.maximum(np.maximum(np.abs(decision), np.abs(expected)), largest[:, None])
        agrees = (
            np.array_equal(theta, decision)
            and np.array_equal(flat[: decision.size], decision.ravel())
            and (case.answering or flat.size == decision.size + _count_size_bounds(case))
            and all(np.array_equal(arrays[k], np.array(case.certificate.get(k, []), dtype=float)) for k in answered)
            and np.array_equal(breakpoints, case.control.breakpoints)
            and control.shape == size.shape
            and bool((np.abs(control - expected) <= DERIVED_TOLERANCE * size).all())
        )
    except InputError as error:
        return [f"it cannot be read: {error}"], "", []
    except Broken as error:
        return [f"the certificate has no control: {error}"], "", []
    except KeyError as error:
        return [f"it holds no array {error}"], "", []
    except (ValueError, TypeError, OverflowError):
        return ["its control and the certificate's are no arrays of one shape"], "", []
    uncompared = sorted(set(arrays) - {*STORED, *answered} - set(_compare_worst_disturbance(case, arrays)))
    different = [] if agrees else ["its control is not the certificate's"]
    different += [text for text in _compare_worst_disturbance(case, arrays).values() if text]
    return different, "it holds the certificate's control", uncompared


def _compare_worst_disturbance(case: Case, arrays: Mapping[str, Any]) -> dict[str, str]:
    """Compare the disturbance of the worst constraint with that of the witness, which was moved inwards against
    rounding."""
    witness = case.certificate.get("witness")
    if "worst_disturbance" not in arrays or not isinstance(witness, Mapping) or witness.get("disturbance") is None:
        return {}
    from sparserob_core.checker.claims.case import numbers

    disturbance = arrays["worst_disturbance"]
    try:
        signal = numbers(witness["disturbance"], "disturbance")
        size = np.abs(disturbance).max(initial=0.0)
        close = signal.shape == disturbance.shape and bool(
            (np.abs(signal - disturbance) <= RECOMPUTED_TOLERANCE * size).all()
        )
    except (Broken, TypeError):  # rows of different lengths, or text
        close = False
    return {"worst_disturbance": "" if close else "its worst disturbance is not that of the witness"}
