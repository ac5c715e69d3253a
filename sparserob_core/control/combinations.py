"""Features of a problem that do not go together: why not, and what to do instead."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from sparserob_core.errors import InputError, Path

FEATURES = (
    "pieces of the system",
    "parameters",
    "drift",
    "delay",
    "initial set",
    "moving set",
    "mixed",
    "curved path",
    "fixed final state",
    "measurable",
    "control_step",
    "curved control_step",
    "group",
    "quadratic cost",
    "prices by piece",
    "haar",
    "sparsest",
    "affine",
    "list of disturbances",
    "integral",
    "entries in t",
    "execution",
    "two classes",
    "pieces of their own",
    "jitter",
)
"""The features of the table "Every pair" in docs/scope.md, in its order."""


@dataclass(frozen=True)
class Refusal:
    """A case in which a feature is refused.

    Parameters
    ----------
    sentence : str
        What is expected instead, and why. Each ``{}`` stands for a name that the problem supplies.
    path : str
        Key of the config that is at fault; empty where the place that finds the case knows it.
    pairs : tuple of str
        Features of the table that are always refused together with this one. It is empty for a special case, such as
        sets of one shape only.
    """

    sentence: str
    path: str = ""
    pairs: tuple[str, ...] = ()


def _list_delivery_cases(path: str) -> dict[str, Refusal]:
    """Return the cases that are refused beside every deviation of the delivered control, at its key."""
    return {
        "fixed final state": Refusal(
            "none beside fixed final values, which a deviation of the control misses: a terminal set such as box",
            path,
            ("fixed final state",),
        ),
        "parameters in no box": Refusal("none beside parameters in another set than a box", path),
        "measurable in a curved set": Refusal(
            "none beside measurable disturbances in a curved set where the system has pieces or parameters", path
        ),
        "curved path and general parameters": Refusal(
            "none beside curved sets of states with parameters that the state does not depend on affinely", path
        ),
    }


REFUSALS: dict[str, dict[str, Refusal]] = {
    "fixed final state": {
        "uncertainty": Refusal(
            "terminal: equals: state {} depends on the uncertainty, so no control can fix its final value to {};"
            " expected a set with interior",
            pairs=("parameters", "initial set", "measurable", "two classes"),
        ),
        "parameters and entries in t": Refusal(
            "final values fixed of states that no parameter reaches, beside the time t"
        ),
        "general parameters and entries in t": Refusal(
            "none beside fixed final values and the time t, or such that the state depends on affinely: to"
            " the first power in B, E and c, and in A where they multiply what depends on none",
            "system.parameters",
        ),
    },
    "execution": {
        **_list_delivery_cases("execution"),
        "affine": Refusal(
            "none under feedback, where the size of the control, and with it that of its error, answers too",
            "execution",
            ("affine",),
        ),
    },
    "jitter": {
        "execution": Refusal(
            "none beside execution: the errors as a disturbance through the columns of B", "jitter", ("execution",)
        ),
        "delay": Refusal(
            "none beside system.delay: late changes as a disturbance through the columns of B", "jitter", ("delay",)
        ),
        "repeat": Refusal(
            "none beside repeat, whose seam is a change too: one period that ends in the initial set", "jitter"
        ),
        "mixed": Refusal("none beside mixed: bounds of the state and of the control apart", "jitter", ("mixed",)),
        "integral": Refusal(
            "none beside integrals with G, which would count what is delivered: an integral of H",
            "jitter",
            ("integral",),
        ),
        **_list_delivery_cases("jitter"),
        "affine": Refusal(
            "0 under feedback: a disturbance through the columns of B, as large as the steps of the control",
            "jitter",
            ("affine",),
        ),
    },
    "pieces of their own": {
        "measurable": Refusal(
            "none where a disturbance of the list is not of the class piecewise_constant",
            pairs=("measurable", "two classes"),
        ),
        "few functions": Refusal(
            "dictionaries.disturbance: fewer functions than pieces are not proven beside disturbances that have"
            " breakpoints of their own"
        ),
    },
    "two classes": {
        "few functions": Refusal(
            "fewer functions than pieces are not proven beside measurable disturbances", "dictionaries.disturbance"
        ),
    },
    "affine": {
        "sparsest": Refusal(  # raised in `sip.method`, which knows no control; a test compares the sentences
            "exchange: with a policy that answers what is measured, a constraint is no row of the decision",
            "method.name",
            ("sparsest",),
        ),
        "plain rows": Refusal(
            "under feedback a constraint is no row of the decision: the method exchange knows such programs"
        ),
        "literal": Refusal("formulation: expected reduced with a policy that answers what is measured, got {!r}"),
        "few functions of the control": Refusal(
            "feedback needs a control that can have any value on every piece: an answer to a measurement does not reach"
            " back before it",
            "policy.name",
        ),
        "parameters": Refusal(
            "feedback needs a system without uncertain parameters: else what is measured is not the disturbance alone",
            "policy.name",
            ("parameters",),
        ),
        "measurable": Refusal(
            "feedback needs a disturbance of the class piecewise_constant, not {}; more pieces in"
            " dictionaries.disturbance come as close to a measurable one as is wanted",
            "policy.name",
            ("measurable", "two classes"),
        ),
        "l1_ball": Refusal("feedback needs a disturbance of the class piecewise_constant, not {}", "policy.name"),
        "budget": Refusal(
            "feedback needs a disturbance without a budget: beside a policy leave it out, which covers every signal"
            " that it admits",
            "policy.name",
        ),
        "pieces of their own": Refusal(
            "feedback needs a disturbance on the pieces of one dictionary, not on some of its own",
            "policy.name",
            ("pieces of their own",),
        ),
        "flat uncertainty": Refusal(
            "feedback needs a set of disturbances and of initial states with an interior, or with sides that can be"
            " listed, which the {} has not: a flat set is a box of its own coordinates, whose directions are the"
            " columns of E",
            "policy.name",
        ),
        "fixed final state and flat uncertainty": Refusal(
            "feedback needs a set of disturbances and of initial states with an interior, or of axes that are points,"
            " beside fixed final states, which the {} has not: a small box of final states does",
            "policy.name",
        ),
        "curved path": Refusal(
            "feedback needs a set of states with flat sides, which the {} has not: a polytope inside"
            " of it comes as close as is wanted",
            "policy.name",
            ("curved path",),
        ),
        "few functions of the disturbance": Refusal(
            "feedback needs a disturbance that takes any value on each of its pieces", "policy.name"
        ),
        "name that is taken": Refusal(
            "feedback needs a path constraint of another name than {}, which is taken", "policy.name"
        ),
        "control_step, repeat and outputs": Refusal(
            "feedback needs a whole state that is measured without noise where a plan with a control_step repeats",
            "policy.name",
        ),
        "group with a charge": Refusal(
            "feedback needs a cost of single channels where the policy is charged {}: without group", "policy.name"
        ),
    },
    "prestabilise": {
        "entries in t": Refusal(
            "an inner loop needs a plant that does not change with time; null does without", "policy.prestabilise"
        ),
        "delay": Refusal("an inner loop needs a control without delay; null does without", "policy.prestabilise"),
        "quadratic cost or group": Refusal(
            "an inner loop needs a cost without quadratic terms and groups; null does without", "policy.prestabilise"
        ),
        "control_step and repeat": Refusal(
            "an inner loop needs no control_step where a plan repeats; null does without", "policy.prestabilise"
        ),
    },
    "resolve": {
        "few functions of the control": Refusal(
            "solving the remaining horizon needs a control in indicators of its pieces (piecewise_constant)", "resolve"
        ),
        "few functions of the disturbance": Refusal(
            "solving the remaining horizon needs a disturbance that takes any value on each of its pieces, since what"
            " is left of another depends on what has been",
            "resolve",
        ),
        "two classes": Refusal("solving the remaining horizon needs disturbances of one class", "resolve"),
        "budget": Refusal(
            "solving the remaining horizon needs a disturbance without a budget, since what is left of it is not"
            " measured",
            "resolve",
        ),
        "pieces of their own": Refusal(
            "solving the remaining horizon needs disturbances on the pieces of one dictionary", "resolve"
        ),
        "integral": Refusal(
            "solving the remaining horizon needs integrals of controls alone, and none beside feedback: what states add"
            " up to between measurements is not known",
            "resolve",
        ),
        "delay": Refusal("solving the remaining horizon needs a control that acts at once, without a delay", "resolve"),
        "outputs": Refusal(
            "solving the remaining horizon needs a policy that measures the whole state, not outputs", "resolve"
        ),
        "control_step and repeat": Refusal(
            "solving the remaining horizon needs a control_step with flat sides, and no feedback beside it, where the"
            " plan repeats",
            "resolve",
        ),
    },
    "horizon": {
        "pieces of their own": Refusal(
            "disturbances on the pieces of their dictionary, which become shorter with the horizon", "disturbance"
        ),
        "budget": Refusal(
            "a disturbance without a budget, which would have to change with the horizon; leave the budget out",
            "disturbance",
        ),
        "entries in t": Refusal(
            "a system that stays the same with time: of another one no shorter horizon is looked at yet", "system"
        ),
        "delay": Refusal(
            "of: horizon: a delay is no share of the horizon, so that nothing can be proven of an interval of horizons;"
            " expected a problem without system.delay"
        ),
        "few functions of the control": Refusal(
            "of: horizon: the control's dictionary has fewer functions than pieces; expected one that takes any"
            " values on its pieces"
        ),
    },
}
"""The cases in which a feature is refused, by the feature and the name of the case, in the order of their check."""


def refusal(feature: str, case: str, *names: object, path: str | Path = (), got: str = "") -> InputError:
    """Return the error for one case of `REFUSALS`.

    Parameters
    ----------
    feature, case : str
        The keys of the case.
    names : object
        What replaces each ``{}`` of the sentence.
    path : str or tuple, optional
        Place of the fault, where the declaration has none.
    got : str, optional
        What the problem has instead.
    """
    declared = REFUSALS[feature][case]
    place, sentence = path or declared.path, declared.sentence.format(*names)
    return InputError(path=place, expected=sentence, got=got) if got else InputError(sentence, path=place)


def refuse_cases(feature: str, cases: Mapping[str, bool | str], *, got: str = "") -> None:
    """Raise `InputError` for the first case that is present, in the order of `REFUSALS`.

    Parameters
    ----------
    feature : str
        The feature that is refused.
    cases : mapping of str to bool or str
        For cases of the feature, whether each is present. A text that is not empty replaces the ``{}`` of its sentence.
    got : str, optional
        What the problem has instead.

    Raises
    ------
    KeyError
        Where a case is not declared.
    """
    undeclared = cases.keys() - REFUSALS[feature].keys()
    if undeclared:
        raise KeyError(f"{feature}: {sorted(undeclared)} are not declared in REFUSALS")
    for case in REFUSALS[feature]:
        if cases.get(case):
            raise refusal(feature, case, cases[case], got=got)


def refused_pairs() -> Iterator[tuple[str, str, str]]:
    """Yield two features that are always refused together, and the sentence that says so, for every such pair."""
    for feature, cases in REFUSALS.items():
        for declared in cases.values():
            for companion in declared.pairs:
                yield feature, companion, declared.sentence
