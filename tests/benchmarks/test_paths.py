"""Guards that every short cut of the responses is worth its lines: a solve as it is, and with one of them turned off,
in turns in one run. The plants of others are left out where the folder that SPARSEROB_PLANTS names is absent."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from unittest.mock import patch

import pytest

import sparserob_core as sr
from sparserob_core.control.response.response import OutputResponse, Propagator
from tests.benchmarks.test_plants import PUSHED, stated
from tests.benchmarks.test_scale import chain
from tests.benchmarks.test_small_problems import problem
from tests.support.places import PLANTS

pytestmark = pytest.mark.benchmark

RESPONSE = "sparserob_core.control.response.response"
NONE = 10**9  # pieces that nothing has


@contextmanager
def piece_by_piece() -> Iterator[None]:
    """Rows go back from piece to piece, whatever the grid."""
    with patch.object(Propagator, "aged", lambda *_: False):
        yield


@contextmanager
def outputs_from_states() -> Iterator[None]:
    """Outputs are made of the states at all breakpoints."""
    at = OutputResponse.at

    def plain(outputs: OutputResponse, *given: object) -> object:
        with patch(f"{RESPONSE}.FEWEST", NONE):
            return at(outputs, *given)  # type: ignore[arg-type]

    with patch.object(OutputResponse, "at", plain):
        yield


@contextmanager
def set_to(**constants: float) -> Iterator[None]:
    """Thresholds at other values, by the modules that they are of."""
    homes = {
        "FEW_STATES": ("sparserob_core.control.enclosures.flows", RESPONSE),
        "FEWEST": (RESPONSE,),
        "SPANS": ("sparserob_core.control.response.lifted",),
    }
    (name, value), *_ = constants.items()
    patches = [patch(f"{home}.{name}", value) for home in homes[name]]
    for one in patches:
        one.start()
    try:
        yield
    finally:
        for one in patches:
            one.stop()


OFF: dict[str, Callable[[], object]] = {
    "by age": piece_by_piece,
    "tables of few states": lambda: set_to(FEW_STATES=0),
    "states and outputs in blocks": lambda: set_to(FEWEST=NONE),
    "outputs in blocks": outputs_from_states,
    "bounds of many pieces": lambda: set_to(SPANS=NONE),
}


def plant(name: str) -> sr.OptimalControlProblem:
    one = stated(name)
    known = one["system"]
    pushed = {} if "E" not in known else {"disturbance": sr.Box(*PUSHED), "disturbance_class": "measurable"}
    return sr.OptimalControlProblem(
        system=sr.LinearSystem(*(known[key] for key in ("A", "B", "E") if key in known)),
        horizon=one["horizon"],
        initial_state=one["centre"],
        initial_set=sr.Box(-one["radius"], one["radius"]),
        control=sr.Box([-1.0], [1.0]),
        path=[sr.PathConstraint(sr.Polytope(one["rows"], one["walls"]), start=one["start"])],
        **pushed,
    )


CASES: dict[str, tuple[Callable[[], sr.OptimalControlProblem], int, tuple[str, ...]]] = {
    "small": (problem, 50, ("by age", "tables of few states")),
    "chain of 100": (lambda: chain(100, 10), 100, ("by age",)),
    "chain of 200": (lambda: chain(200, 10), 1000, ("by age", "states and outputs in blocks", "bounds of many pieces")),
    "chain of 200, long": (
        lambda: chain(200, 10, 0.5),
        10_000,
        ("states and outputs in blocks", "outputs in blocks", "bounds of many pieces"),
    ),
    "building": (lambda: plant("building"), 100, ("by age",)),
    "heat": (lambda: plant("heat"), 100, ("by age",)),
}
WORTH = {("chain of 200, long", "bounds of many pieces"): 1.5}


@pytest.mark.parametrize("case", CASES)
def test_what_a_short_cut_is_worth(case: str, capsys: pytest.CaptureFixture[str]) -> None:
    make, pieces, asked = CASES[case]
    if case in ("building", "heat") and not PLANTS.is_dir():
        pytest.skip("SPARSEROB_PLANTS names no folder of plants")

    def spent() -> tuple[float, float]:
        posed, began = make(), time.process_time()
        found = sr.solve(posed, control={"name": "piecewise_constant", "pieces": pieces})
        assert found.status == "certified"
        return time.process_time() - began, float(found.value)

    spent()  # what is imported is not measured
    whole, value = spent()
    for name in asked:
        with OFF[name]():  # type: ignore[attr-defined]
            without, other = spent()
        with capsys.disabled():
            print(f"\n{case}, {pieces} pieces: {whole:.2f} s, without {name} {without:.2f} s, {without / whole:.2f}")
        assert abs(other - value) <= 1e-6 * (1.0 + abs(value))
        assert without >= WORTH.get((case, name), 0.0) * whole
