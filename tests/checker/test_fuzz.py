"""Guards checker: whatever a file says, a verdict or an error of the input, never an exception, never a proof of more:
every number, array and structure of every kind of certificate made wrong in every way."""

from __future__ import annotations

import copy
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.errors import InputError
from tests.checker.test_check import CONFIGS, DECAY, SPRING, on
from tests.support.draws import taken
from tests.support.fuzzing import NOT_FINITE, tampered

PUSHED: dict[str, Any] = {
    "name": "linear",
    "system": {"A": [[0, 1], [-1, -0.1]], "B": [[0], [1]], "E": [[0], [1]]},
    "horizon": 2.0,
    "initial_state": [0.5, 0],
    "control": {"box": 1.0},
    "disturbance": {"box": [0.1]},
    "path": [{"box": [0.9, None], "from": 0.5}],
    "terminal": [{"box": [0.4, 0.5]}],
}
AFFINE = {"name": "affine", "cost": "peak"}
SEEN: dict[str, Any] = {
    **PUSHED,
    "initial_state": {"centre": [0.5, 0], "box": [0.02, 0.02]},
    "measurements": {"C": [[1.0, 0.0]], "noise": {"box": [0.01]}},
}
BESIDE: dict[str, Any] = {
    **DECAY,
    "system": {"A": [["-1 - 0.2*sin(t)"]], "B": [["1 + p1*t"]], "E": [[1.0]], "parameters": {"p1": [-0.1, 0.2]}},
    "disturbance": {"box": [0.05]},
}
KINDS: dict[str, dict[str, Any]] = {
    "known": on(6, {**SPRING, "horizon": 2.0, "path": [{"box": [1.2, None], "from": 0.3}], "terminal": [{"box": 0.9}]}),
    "parameter": on(6, DECAY),
    "initial set": on(4, {**DECAY, "initial_state": {"centre": [2], "box": [0.05]}}),
    "curved": CONFIGS["ellipsoidal"] | {"dictionaries": {"control": {"name": "piecewise_constant", "pieces": 6}}},
    "infeasible": CONFIGS["infeasible"] | {"dictionaries": {"control": {"name": "piecewise_constant", "pieces": 4}}},
    "refuted": on(8, SPRING, method={"name": "nominal"}),
    "refuted parameter": on(6, DECAY, method={"name": "nominal"}),
    "equality": CONFIGS["equality"],
    "walsh": on(8, DECAY) | {"dictionaries": {"control": {"name": "walsh", "pieces": 8, "functions": 4}}},
    "steps": on(6, {**DECAY, "control_step": {"box": 0.8}, "initial_control": [0.0]}),
    "mixed": on(4, {**DECAY, "path": [{"mixed": {"H": [[1.0]], "G": [[0.3]], "h": [1.9]}, "from": 0.2}]}),
    "quadratic": on(5, {**DECAY, "cost": {"l1": 1.0, "final": {"Q": [[0.3]]}}}),
    "norms": on(
        4,
        {
            "name": "linear",
            "system": {"A": [[-0.3, 0.2], [0.1, -0.5]], "B": [[1.0, 0.2], [-0.3, 1.0]]},
            "horizon": 2.0,
            "initial_state": [1.0, 0.8],
            "control": {
                "polytope": {"H": [[1, 0], [-1, 0], [0, 1], [0, -1], [-1, -1]], "h": [0.8, 0.8, 0.8, 0.8, 0.7]}
            },
            "cost": {"group": "all"},
            "terminal": [{"box": [0.3, 0.3]}],
        },
    ),
    "sparsest": on(5, DECAY, method={"name": "sparsest"}),
    "feedback": on(4, PUSHED, policy=AFFINE),
    "feedback, nominal cost": on(3, {**PUSHED, "control_step": {"box": 1.5}}, policy={"name": "affine"}),
    "feedback, worst effort": on(
        3,
        {**PUSHED, "initial_state": {"centre": [0.5, 0], "box": [0.02, 0.02]}},
        policy={"name": "affine", "cost": "worst"},
    ),
    "feedback, curved": on(3, {**PUSHED, "control": {"norm": {"p": 2, "radius": 2.0}}, "path": []}, policy=AFFINE),
    "feedback, infeasible": on(
        3, {**PUSHED, "disturbance": {"box": [2.0]}, "terminal": [{"box": [0.05, 0.05]}]}, policy=AFFINE
    ),
    "integral": on(4, {**DECAY, "integral": [{"G": [[1.0]], "upper": 3.0}, {"H": [[1.0]], "from": 0.2, "upper": 9.0}]}),
    "varying": on(
        4,
        {
            **DECAY,
            "system": {"A": [["-1 - 0.2*sin(t)"]], "B": [["1/(4 - t)"]], "E": [[1.0]]},
            "disturbance": {"box": [0.05]},
            "initial_state": {"centre": [2], "box": [0.05]},
        },
    ),
    "varying, parameter": on(3, BESIDE),
    "varying, measurable": on(
        3,
        {
            **DECAY,
            "system": {"A": [["-1 - 0.2*sin(t)"]], "B": [[1]], "E": [["1 + t"]]},
            "disturbance": {"box": [0.05]},
            "disturbance_class": "measurable",
        },
    ),
    "list": on(
        3,
        {
            **PUSHED,
            "system": {"A": [[0, 1], [-1, -0.1]], "B": [[0], [1]]},
            "disturbance": [
                {"set": {"box": [0.1]}, "E": [[0], [1]], "breakpoints": [0, 0.4, 1.7, 2]},
                {"set": {"norm": {"p": 2, "radius": 0.02}}, "E": [[1, 0], [0, 1]], "pieces": 2},
            ],
        },
    ),
    "execution": on(4, {**DECAY, "system": {"A": [[-1.0]], "B": [[1.0]]}, "execution": [0.05]}),
    "repeat": on(
        3, {**PUSHED, "initial_state": {"centre": [0.5, 0], "box": [0.3, 0.3]}, "repeat": True}, policy=AFFINE
    ),
    "feedback, outputs": on(3, SEEN, policy=AFFINE),
    "feedback, integral": on(3, {**PUSHED, "integral": [{"G": [[1.0]], "upper": 3.0}]}, policy=AFFINE),
    "bound": on(3, {**PUSHED, "terminal": []}),
    "bound, parameter": on(3, DECAY),
    "bound, outputs": on(3, {**SEEN, "terminal": []}),
    "bound, varying": on(3, BESIDE),
}
PARTS = 8
SECONDS = 5.0  # of a check, which ends without a verdict then: the honest ones take a fifth of one
OF = 13  # parts of the tamperings, of which a run sees `PARTS`: others of every kind, so that all kinds have their time
SEED = 24


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Any:
    made: dict[str, Path] = {}

    def run(kind: str) -> Path:
        if kind not in made:
            made[kind] = tmp_path_factory.mktemp("honest") / "run"
            if kind.startswith("bound"):
                sr.bound(copy.deepcopy(KINDS[kind]), out=made[kind])
            else:
                sr.run(copy.deepcopy(KINDS[kind]), out=made[kind], quiet=True, figures=False)
        return made[kind]

    return run


def judged(directory: Path) -> str:
    """The status of a check; ``input`` where the input is at fault. Anything else is an error of the test."""
    try:
        return sr.check(directory, seconds=SECONDS).status
    except InputError as error:
        assert str(error)
        return "input"


def wrong(source: Path, target: Path, part: int, parts: int) -> list[str]:
    """The numbers that are not finite and were not refused, of one of ``parts`` random parts of all tamperings."""
    shutil.copytree(source, target)
    assert judged(target) == "verified"
    failures = []
    for file in sorted({"bound.json", "certificate.json", "result.json"} & {made.name for made in target.iterdir()}):
        text = (target / file).read_text()
        rng = np.random.default_rng(SEED)
        for name, place, data in tampered(json.loads(text), SEED):
            if rng.integers(parts) != part:
                continue
            (target / file).write_text(json.dumps(data))
            status = judged(target)
            if name in NOT_FINITE and status != "input":
                failures.append(f"{file} {'.'.join(map(str, place))}: {name}: {status}")
        (target / file).write_text(text)
    return failures


@pytest.mark.parametrize("kind", ["parameter", "feedback"])
def test_some_of_what_may_be_wrong_is_a_verdict_or_an_error_of_the_input(
    kind: str, honest: Any, tmp_path: Path
) -> None:
    assert wrong(honest(kind), tmp_path / "copy", 7, 400) == []


def test_a_decision_where_nothing_is_feasible_is_no_reason_to_fail(honest: Any, tmp_path: Path) -> None:
    """What a result says of costs follows from the certificate's, which has none."""
    shutil.copytree(honest("infeasible"), tmp_path / "copy")
    file = tmp_path / "copy" / "certificate.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"decision": [[0.0] * 4]}))
    assert judged(tmp_path / "copy") == "refuted"


@pytest.mark.slow
@pytest.mark.parametrize("part", range(min(PARTS, taken(PARTS))))
@pytest.mark.parametrize("kind", KINDS)
def test_whatever_is_wrong_is_a_verdict_or_an_error_of_the_input(
    kind: str, part: int, honest: Any, tmp_path: Path
) -> None:
    assert wrong(honest(kind), tmp_path / "copy", (part + list(KINDS).index(kind)) % OF, OF) == []


def test_a_number_that_is_not_finite_is_named(honest: Any, tmp_path: Path) -> None:
    shutil.copytree(honest("parameter"), tmp_path / "copy")
    file = tmp_path / "copy" / "certificate.json"
    data = json.loads(file.read_text())
    for written, said in (("NaN", "nan"), ("-Infinity", "-inf"), ("1e999", "inf"), ("7" * 400, "a whole number of")):
        text = json.dumps(data | {"fewest_active": {"proof": {"control": {"tolerance": "HERE"}}}})
        file.write_text(text.replace('"HERE"', written))
        with pytest.raises(
            InputError, match=r"fewest_active\.proof\.control\.tolerance: expected a finite number or null, got " + said
        ):
            sr.check(tmp_path / "copy")


def test_the_same_seed_makes_the_same_tamperings(honest: Any) -> None:
    data = json.loads((honest("parameter") / "certificate.json").read_text())
    first, second = ([(name, place) for name, place, _ in tampered(data, SEED)] for _ in range(2))
    assert first == second and len(first) > 400
    changed = [repr(made) != repr(data) for _, _, made in tampered(data, SEED)]
    assert np.mean(changed) > 0.9
