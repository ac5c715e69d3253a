"""What the paper claims in its experiments section, what the runs say to it, and a verdict in a sentence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from words import above, between, broken, cost, draws, percent, percent_up, worst

Numbers = Mapping[str, Any]
Claim = tuple[str, str, str]


def claims(numbers: Numbers) -> list[Claim]:
    """One row per claim, in the order of the paper."""
    return [
        _equivalent(numbers),
        _solved(numbers),
        _answered(numbers),
        _survivors(numbers),
        _numerical(numbers),
        _ignored(numbers),
        _scenarios(numbers),
        _weights(numbers),
        _exact(numbers),
        _printed2(numbers),
        _parameters(numbers),
        _attention(numbers),
    ]


def _equivalent(numbers: Numbers) -> Claim:
    computed = (
        f"the proven control of the repaired experiment 1 has |u| <= {numbers['largest']:.6g}, and coefficients with "
        f"l1-norm {numbers['coefficients']:.4g}"
    )
    return (
        "the bound on the control can be written equivalently as a bound on the l1-norm of its coefficients",
        computed,
        (
            "Sufficient, not equivalent: for indicator functions the exact condition is on every coefficient alone, and"
            " it is what is imposed here."
        ),
    )


def _solved(numbers: Numbers) -> Claim:
    runs, deviation = numbers["runs"], numbers["deviation"]
    computed = (
        f"{runs['printed1']['status']} as printed, and {runs['window1']['status']} with the path constraint from 0.3"
        f" on: the disturbance alone moves x(5) by ({deviation[0]:.4f}, {deviation[1]:.4f}); the largest bound with a"
        f" solution is below {above(numbers['bracket'][1])}"
    )
    return (
        "experiment 1, |w_i| <= 0.4, is solved",
        computed,
        "Not as printed: x(0) violates the path constraint, and no open-loop control withstands this disturbance.",
    )


def _answered(numbers: Numbers) -> Claim:
    found = numbers["answered"]
    computed = (
        f"with the state measured at 50 breakpoints and answered affinely, the path constraint from 0.3 on, up to"
        f" |w_i| <= {math.floor(found['lower'] * 1e4) / 1e4:.4f}, proven, where a control that is fixed beforehand"
        f" withstands {math.floor(numbers['bracket'][0] * 1e4) / 1e4:.4f}; beyond"
        f" {math.ceil(found['causal_upper'] * 1e4) / 1e4:.4f} no causal control exists"
    )
    return (
        "the same, for a control that may answer what it measures (not in the paper)",
        computed,
        (
            "Feedback withstands about four times as much. The printed 0.4 is out of reach of every causal control with"
            " these pieces, not of affine ones alone."
        ),
    )


def _survivors(numbers: Numbers) -> Claim:
    computed = (
        f"the paper's search gives a control that {draws(numbers, 'search1')} of the draws do not break; it is "
        f"{numbers['runs']['search1']['status']}, by {worst(numbers, 'search1'):.4g}"
    )
    return (
        "9990 of 10 000 trajectories, 99.9 %, satisfy the constraints: robustly",
        computed,
        (
            "Such shares are reproduced, the conclusion is not: one admissible disturbance misses the terminal set by"
            " several times its width."
        ),
    )


def _numerical(numbers: Numbers) -> Claim:
    computed = (
        f"the largest violation among the draws is {numbers['draws']['search1']['worst']:.3g}; two ways to compute"
        f" x(5), for all draws, agree to {numbers['disagreement']:.0e}"
    )
    return (
        "the violations that are seen stem from unavoidable numerical errors",
        computed,
        "No: the violations are real. They are the visible edge of a control that is not robust.",
    )


def _ignored(numbers: Numbers) -> Claim:
    computed = (
        f"the non-robust control: broken by {broken(numbers, 'nominal1')} of the draws, at worst by"
        f" {worst(numbers, 'nominal1'):.4g}"
    )
    return "neglecting the disturbance leads to violations", computed, "True."


def _scenarios(numbers: Numbers) -> Claim:
    told = []
    for count in (1000, 5000):
        name = f"scenario1_{count}"
        promised = percent_up(numbers["runs"][name]["scenario_bound"]["after"])
        told.append(
            f"{count} scenarios: broken by {broken(numbers, name)} of the draws (promised: at most {promised}), in the"
            f" worst case by {worst(numbers, name):.4g}"
        )
    return (
        "the scenario approach reduces violations significantly, but some remain",
        "; ".join(told),
        (
            "True of the draws, as its theory promises. In the worst case hardly anything is gained, by scenarios or by"
            " the paper's search."
        ),
    )


def _weights(numbers: Numbers) -> Claim:
    first, *_, before, last = numbers["epsilon"]
    computed = (
        f"repaired data: from epsilon = {first['epsilon']:g} to {last['epsilon']:g} the cost falls from"
        f" {cost(first['cost'])} to {cost(last['cost'])}, the share of time active from {percent(first['active'])} to"
        f" {percent(last['active'])}; the last two controls differ by {before['distance']:.2g} in L1"
    )
    return "as epsilon decreases the controls approach one another and become sparse", computed, "True."


def _exact(numbers: Numbers) -> Claim:
    run = numbers["runs"]["repaired1"]
    return (
        "exact solutions: the value and the optimiser of the semi-infinite program",
        f"repaired data: {run['status']}, value {between(run)}",
        "True as a theorem; attained here by exchange, and proven.",
    )


def _printed2(numbers: Numbers) -> Claim:
    run = numbers["runs"]["printed2"]
    return (
        "experiment 2, |x1| <= 0.5 for all times from x1(0) = -1, is solved",
        f"{run['status']}: {run['message']}",
        "Not as printed; with the constraint from 1.6 on it can be.",
    )


def _parameters(numbers: Numbers) -> Claim:
    run = numbers["runs"]["repaired2"]
    computed = (
        f"repaired data: {run['status']}, J = {cost(run['cost'])}, active {percent(run['sparsity']['active_fraction'])}"
        f" of the time, broken by {broken(numbers, 'repaired2')} of the draws; with 1000 scenarios by"
        f" {broken(numbers, 'repaired2_scenario_1000')}"
    )
    return (
        (
            "despite uncertain parameters all trajectories satisfy the constraints, and the control is active over a"
            " small portion of the time"
        ),
        computed,
        "True of the repaired problem, and proven for every parameter, not for ten thousand.",
    )


def _attention(numbers: Numbers) -> Claim:
    run = numbers["runs"]["repaired3"]
    computed = (
        f"{numbers['runs']['printed3']['status']} as printed; repaired: {run['status']}, J = {cost(run['cost'])}, rate"
        f" active {percent(run['sparsity']['active_fraction'])} of the time, broken by {broken(numbers, 'repaired3')}"
        " of the draws"
    )
    return (
        "minimum attention, |w_i| <= 0.4: a sparse rate; the control was simulated for 10 000 disturbances",
        computed,
        "The rate is sparse; for the printed disturbance no control is robust.",
    )
