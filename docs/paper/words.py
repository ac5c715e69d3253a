"""How numbers become words and tables on the page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sparserob_core.sip.scenario_bound import at_most

DESIGNS = {
    "nominal1": "non-robust",
    "scenario1_1000": "1000 scenarios",
    "scenario1_5000": "5000 scenarios",
    "search1": "the paper's search",
    "repaired1_nominal": "non-robust",
    "repaired1_scenario_1000": "1000 scenarios",
    "repaired1_scenario_5000": "5000 scenarios",
    "repaired1": "robust",
    "repaired2_nominal": "non-robust",
    "repaired2_scenario_1000": "1000 scenarios",
    "repaired2_scenario_5000": "5000 scenarios",
    "repaired2": "robust",
    "scenario3_1000": "printed disturbance, 1000 scenarios",
    "repaired3_nominal": "repaired, non-robust",
    "repaired3": "repaired, robust",
}
COLUMNS = ("design", "J", "draws that break it", "promised by the scenario theory", "worst case", "status")


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(
        "| " + " | ".join(" ".join(cell.replace("|", "\\|").split()) for cell in line) + " |" for line in lines
    )


def percent(share: float) -> str:
    """A share with as many digits as ten thousand draws have."""
    return f"{100 * share:.4g} %"


def cost(value: float) -> str:
    """A cost to six digits."""
    return f"{value:.6g}"


def broken(numbers: Mapping[str, Any], name: str) -> str:
    """The share of draws that break a constraint."""
    drawn = numbers["draws"][name]
    return percent(drawn["broken"] / drawn["count"])


def draws(numbers: Mapping[str, Any], name: str) -> str:
    """The share of draws that keep all constraints."""
    drawn = numbers["draws"][name]
    return percent(1.0 - drawn["broken"] / drawn["count"])


def worst(numbers: Mapping[str, Any], name: str) -> float:
    """The largest violation that is known of a run's control."""
    return float(numbers["runs"][name]["worst"]["violation"])


def design_rows(numbers: Mapping[str, Any], names: Sequence[str]) -> str:
    """One line per design: cost, draws, what the scenario theory promises, and the worst case."""
    return table(COLUMNS, [_design(numbers, name) for name in names])


def _design(numbers: Mapping[str, Any], name: str) -> tuple[str, ...]:
    run = numbers["runs"][name]
    bound = run["scenario_bound"]
    promised = (
        ""
        if bound is None
        else f"at most {percent_up(bound['after'])} (before the solution was seen: {percent_up(bound['before'])})"
    )
    proven = run["status"] in ("certified", "verified")
    case = (
        "proven: no violation"
        if proven
        else f"a violation of {worst(numbers, name):.4g} ({run['worst']['constraint']})"
    )
    return DESIGNS[name], cost(run["cost"]), broken(numbers, name), promised, case, run["status"]


def percent_up(share: float) -> str:
    """An upper bound on a share, to two digits, rounded up."""
    return f"{at_most(100 * share)} %"


def below(value: float) -> str:
    """A lower bound to six decimals, rounded down."""
    return f"{math.floor(value * 1e6) / 1e6:.6f}"


def above(value: float) -> str:
    """An upper bound to six decimals, rounded up."""
    return f"{math.ceil(value * 1e6) / 1e6:.6f}"


def whole(count: int) -> str:
    """A whole number with its thousands set apart."""
    return f"{count:,}".replace(",", " ")


def between(run: Mapping[str, Any]) -> str:
    """Both bounds of a run to nine decimals, rounded away from one another."""
    return (
        f"between {math.floor(run['lower_bound'] * 1e9) / 1e9:.9f} and {math.ceil(run['upper_bound'] * 1e9) / 1e9:.9f}"
    )
