"""The page docs/paper.md, from the numbers of the runs: what the paper says, what was computed, and what follows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from claims import claims
from words import above, below, between, cost, design_rows, draws, percent, table, whole, worst

Numbers = Mapping[str, Any]

HEAD = """# The paper, and what is true of it

Written by `make paper`: it runs every experiment of the paper, draws every figure of its experiments section, and sets
what it says beside what was computed. But for the data of the problems, no number on this page was typed; all are in
[numbers.json](paper/numbers.json). It takes a few minutes, most of them for the paper's own search at its full size.

Three kinds of statement are kept apart. *Proven*: for the whole continuum of times, disturbances and parameters, by the
status of a run ([what each status means](method.md)). *Worst case*: a disturbance or parameter that was found and
breaks a constraint by so much; it is enough to refute. *Draws*: {count} random disturbances (every piece independent
and uniform) or parameters, followed by matrix exponentials and checked at the ends of the pieces; they prove nothing,
and this page shows how little.
"""

PRINTED = """## Experiment 1 as printed: a disturbance that no control withstands

As printed the problem is infeasible: {printed}. With the path constraint from t = 0.3 on it still is: {window}.

More exactly, the disturbance alone moves x(5) by ({deviation[0]:.4f}, {deviation[1]:.4f}) to either side; the control
is computed beforehand and cannot answer. What can be done with the printed disturbance is what the paper does, to
sample: the four designs below are solved with the path constraint from 0.3 on.

{designs}

The search is the paper's own at its full size (simulated annealing over {indices} numbers). Its control survives
{survived} of the draws; the worst disturbance breaks a constraint by {broken:.3g}. Both are true, because independent
draws average out: the standard deviation of x(5) is ({spread[0]:.3f}, {spread[1]:.3f}), and the worst case is
{ratio:.0f} times as far.

![States under the printed disturbance: four designs](figures/paper/experiment1_printed_states.png)

![Controls for the printed disturbance](figures/paper/experiment1_printed_controls.png)

![Where ten thousand draws end, and what disturbances can reach](figures/paper/experiment1_ends.png)
"""

REPAIRED = """## Experiment 1 repaired

The largest bound on |w_i| that some control withstands lies between {low} (proven feasible) and {high} (proven
infeasible), with the path constraint from t = 0.3 on. With 0.06 the value is {between}, and the constraints are proven;
the control acts {active} of the time.

{designs}

![States for the repaired data: four designs](figures/paper/experiment1_states.png)

![Controls for the repaired data](figures/paper/experiment1_controls.png)

The control of the paper's search and the proven one, ten thousand draws each:

![States under the two robust designs](figures/paper/experiment1_robust_states.png)

### The weight of the regulariser

Optimisers of the regularised problem, each proven to keep all constraints. The distance is that to the last control, in
L1.

{sweep}

![Controls for several weights of the regulariser](figures/paper/experiment1_epsilon.png)
"""

PARAMETERS = """## Experiment 2: uncertain parameters

As printed: {printed}. With the path constraint from t = 1.6 on, the value is {between}, and the constraints are proven
for every parameter. The constraint that is closest to being broken is {constraint} at p = ({parameter}), {vertex}.

{designs}

![States for uncertain parameters](figures/paper/experiment2_states.png)

![Controls for uncertain parameters](figures/paper/experiment2_controls.png)
"""

ATTENTION = """## Experiment 3: minimum attention

As printed: {printed}. Repaired (|w_i| <= 0.05, path constraint from t = 0.3 on) the value is {between}, proven; the
rate of the control acts {active} of the time. For the printed disturbance 0.4 the control was designed for 1000
scenarios.

{designs}

![Minimum attention: states, control and rate](figures/paper/experiment3.png)
"""


def page(numbers: Numbers) -> str:
    """The whole page."""
    head = HEAD.format(count=whole(numbers["draws"]["repaired1"]["count"]))
    return "\n".join(
        [head, _claims(numbers), _printed(numbers), _repaired(numbers), _parameters(numbers), _attention(numbers)]
    )


def _claims(numbers: Numbers) -> str:
    rows = table(("the paper", "computed here", "verdict"), claims(numbers))
    return f"## Claim by claim\n\n{rows}\n"


def _printed(numbers: Numbers) -> str:
    runs, names = numbers["runs"], ("nominal1", "scenario1_1000", "scenario1_5000", "search1")
    return PRINTED.format(
        printed=runs["printed1"]["message"],
        window=runs["window1"]["message"],
        deviation=numbers["deviation"],
        spread=numbers["spread"],
        designs=design_rows(numbers, names),
        indices=whole(numbers["indices"]),
        ratio=numbers["deviation"][0] / numbers["spread"][0],
        survived=draws(numbers, "search1"),
        broken=worst(numbers, "search1"),
    )


def _repaired(numbers: Numbers) -> str:
    run, names = (
        numbers["runs"]["repaired1"],
        ("repaired1_nominal", "repaired1_scenario_1000", "repaired1_scenario_5000", "repaired1"),
    )
    sweep = [
        (f"{entry['epsilon']:g}", cost(entry["cost"]), percent(entry["active"]), f"{entry['distance']:.4f}")
        for entry in numbers["epsilon"]
    ]
    return REPAIRED.format(
        low=below(numbers["bracket"][0]),
        high=above(numbers["bracket"][1]),
        between=between(run),
        active=percent(run["sparsity"]["active_fraction"]),
        designs=design_rows(numbers, names),
        sweep=table(("epsilon", "J", "acts", "distance"), sweep),
    )


def _parameters(numbers: Numbers) -> str:
    run, names = (
        numbers["runs"]["repaired2"],
        ("repaired2_nominal", "repaired2_scenario_1000", "repaired2_scenario_5000", "repaired2"),
    )
    vertex = (
        "which is no vertex of the box: to try the vertices is not enough"
        if numbers["interior"]
        else "a vertex of the box"
    )
    return PARAMETERS.format(
        printed=numbers["runs"]["printed2"]["message"],
        between=between(run),
        constraint=run["worst"]["constraint"],
        parameter=", ".join(f"{value:.4f}" for value in run["worst"]["parameter"]),
        vertex=vertex,
        designs=design_rows(numbers, names),
    )


def _attention(numbers: Numbers) -> str:
    run, names = numbers["runs"]["repaired3"], ("scenario3_1000", "repaired3_nominal", "repaired3")
    return ATTENTION.format(
        printed=numbers["runs"]["printed3"]["message"],
        between=between(run),
        active=percent(run["sparsity"]["active_fraction"]),
        designs=design_rows(numbers, names),
    )
