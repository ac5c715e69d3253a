"""Guards checker: finished runs are verified, and no forged one is: every kind of forgery once crudely, and once so
that only the mathematics can notice."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

import sparserob_core as sr
from sparserob_core.checker.claims import claims
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.outcome import Finding
from sparserob_core.errors import SparseRobError
from sparserob_core.experiment.assemble import dictionaries_of, gap_tolerance, problem_of
from sparserob_core.experiment.check.check import Check, check
from sparserob_core.experiment.config.load import load_config
from tests.support.problems import spring
from tests.support.subtle import RUNS, SUBTLE
from tests.support.tampering import (
    CONFIG,
    DECISION,
    FIGURES,
    FILES,
    KINDS,
    MULTIPLIERS,
    NONSENSICAL,
    PROOF,
    WITNESS,
    Change,
    Forgery,
    copied,
    entry,
    forged,
)

CRUDE = [*KINDS][::12]
JUDGED = claims.judged

SPRING = spring(0.05)
DECAY: dict[str, Any] = {
    "name": "linear",
    "system": {"A": [["-p1"]], "B": [[1]], "parameters": {"p1": [0.5, 1.0]}},
    "horizon": 1.0,
    "initial_state": [2],
    "control": {"box": 1.0},
    "terminal": [{"box": [0.5]}],
}


def on(pieces: int, problem: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {
        "problem": problem,
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
        "observers": [],
        **more,
    }


CONFIGS: dict[str, dict[str, Any]] = {
    "known": on(40, SPRING),
    "one parameter": on(20, DECAY),
    "two parameters": on(
        20,
        {
            **SPRING,
            "system": {
                "A": [[0, 1], ["-2 + p1", "-0.5"]],
                "B": [[0], ["1 + p2"]],
                "parameters": {"p1": [-0.02, 0.02], "p2": [-0.02, 0.02]},
            },
            "horizon": 2.0,
            "disturbance": None,
            "path": [],
            "terminal": [{"box": [0.6, 0.9]}],
        },
    ),
    "infeasible": on(
        20,
        {
            "name": "linear",
            "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
            "horizon": 2.0,
            "initial_state": [1, 0],
            "control": {"box": 1.0},
            "disturbance": {"box": [0.0, 0.4]},
            "terminal": [{"box": [0.3, 0.3]}],
        },
    ),
    "refuted": on(40, SPRING, method={"name": "nominal"}),
    "refuted parameter": on(20, DECAY, method={"name": "nominal"}),
    "minimum attention": on(
        25,
        {
            **SPRING,
            "name": "minimum_attention",
            "initial_control": 0.0,
            "rate": {"box": 2.0},
            "disturbance": {"box": [0.02, 0.02]},
        },
    ),
    "walsh": {
        "problem": {**SPRING, "disturbance": {"box": [0.03, 0.03]}},
        "observers": [],
        "dictionaries": {
            "control": {"name": "walsh", "pieces": 32, "functions": 16},
            "disturbance": {"name": "piecewise_constant", "pieces": 32},
        },
    },
    "haar": {
        "problem": {**SPRING, "disturbance": {"box": [0.02, 0.02]}},
        "observers": [],
        "dictionaries": {
            "control": {"name": "haar", "pieces": 32, "functions": 16},
            "disturbance": {"name": "piecewise_constant", "pieces": 32},
        },
    },
    "ellipsoidal": on(
        15,
        {
            **SPRING,
            "system": {"A": [[0, 1], [-1, -0.1]], "B": [[0], [1]]},
            "horizon": 3.0,
            "initial_state": [1, 0],
            "control": {"box": 0.5},
            "disturbance": {"ellipsoid": {"centre": [0, 0], "shape": [[0.0004, 0.0001], [0.0001, 0.0004]]}},
            "path": [],
            "terminal": [{"ellipsoid": {"centre": [0, 0], "shape": [[0.36, 0], [0, 0.25]]}}],
        },
    ),
    "equality": on(
        10,
        {
            "name": "linear",
            "system": {
                "A": [[0, 1, 0], ["-2 + p1", -0.5, 0], [0, 0, 0]],
                "B": [[0], [1], [1]],
                "E": [[1], [0], [0]],
                "parameters": {"p1": [-0.5, 0.5]},
            },
            "horizon": 3.0,
            "initial_state": [0.5, 0, 1],
            "control": {"box": 1.0},
            "disturbance": {"box": [0.01]},
            "terminal": [{"equals": [None, None, 0.0]}],
        },
    ),
    "integrator": on(10, {**DECAY, "system": {"A": [[0]], "B": [[1]]}, "control": {"box": 2.0}}),
    "tiny": on(
        10,
        {
            **DECAY,
            "system": {"A": [[0]], "B": [[1]]},
            "initial_state": [2e-6],
            "control": {"box": 1e-5},
            "terminal": [{"box": [5e-7]}],
        },
    ),
    "growth": on(
        4,
        {
            **DECAY,
            "system": {"A": [[1.0]], "B": [[1]], "E": [[1, -1]]},
            "initial_state": [0],
            "disturbance": {"box": {"lower": [-0.01, -0.01], "upper": [0.01, 0.01]}},
            "terminal": [{"box": [1.0]}],
        },
    ),
    "parameters in a polytope": on(
        6,
        {
            **SPRING,
            "system": {
                "A": [["-0.3 + 0.1*p1", 1.0], [0.0, "-0.5+0.2*p2"]],
                "B": [[0.0], [1.0]],
                "parameters": {
                    "names": ["p1", "p2"],
                    "polytope": {
                        "H": [
                            [0.2978, -0.0231],
                            [0.6863, -0.0413],
                            [1.1229, 0.2146],
                            [0.7865, -0.4354],
                            [1.0277, 0.6719],
                            [-0.755, -0.2983],
                        ],
                        "h": [0.3142, 0.61, 0.7822, 0.6021, 0.7651, 0.7853],
                    },
                },
            },
            "horizon": 2.0,
            "initial_state": [1.0, 0.0],
            "control": {"box": 2.0},
            "disturbance": None,
            "path": [],
            "terminal": [{"box": {"lower": [None, -0.5], "upper": [0.9, None]}}],
        },
    ),
    "rounded": {
        "problem": {
            **DECAY,
            "system": {"A": [[-1.0]], "B": [[1, 1]]},
            "control": {"norm": {"p": 1.5, "radius": 1.0}},
            "terminal": [{"box": [10.0]}],
        },
        "dictionaries": {"control": {"name": "walsh", "pieces": 4}},
        "observers": [],
    },
}
CONFIGS |= {name: on(pieces, problem) for name, (pieces, problem) in RUNS.items()}
STATUS = {"infeasible": "infeasible", "refuted": "refuted", "refuted parameter": "refuted"}
Runs = Callable[[str], Path]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    """The directory of an honest run, by its name; each is run once."""
    made: dict[str, Path] = {}

    def directory(name: str) -> Path:
        if name not in made:
            made[name] = tmp_path_factory.mktemp("honest") / "run"
            sr.run(copy.deepcopy(CONFIGS[name]), out=made[name], figures=False)
        return made[name]

    return directory


def failing(found: Check) -> list[str]:
    return [f"{claim.name}: {claim.text}" for claim in found.claims if claim.verdict != "holds"]


@pytest.mark.first(4)
@pytest.mark.parametrize("name", CONFIGS)
def test_every_claim_of_an_honest_run_holds(name: str, runs: Runs) -> None:
    found = check(runs(name))
    assert failing(found) == []
    assert found.status == "verified"
    assert json.loads((runs(name) / "result.json").read_text())["status"] == STATUS.get(name, "certified")
    assert {"config", "result.json", "solution.npz"} < {claim.name for claim in found.claims}


@dataclass
class Honest:
    """An honest run in memory: what its files say, and what its config describes."""

    directory: Path
    config: dict[str, Any]
    certificate: dict[str, Any]
    result: dict[str, Any]
    case: Case
    tolerance: float | None

    @staticmethod
    def of(directory: Path) -> Honest:
        files = copied(directory)
        case, tolerance = described(files.config, files.certificate)
        return Honest(directory, files.config, files.certificate, files.result, case, tolerance)

    def refuses(self, change: Change, whole: bool) -> bool:
        """Whether the checker does not accept the run after a change, by its mathematics alone: no digest is compared,
        and the other files agree with the change. A claim is not shown, or the input is at fault; anything else is an
        error of the test. What follows a claim that is not shown is derived where the ``whole`` is asked for."""
        files = Forgery(self.directory, *(copy.deepcopy(one) for one in (self.config, self.certificate, self.result)))
        change(files)
        certificate = json.loads(json.dumps(files.certificate))
        try:
            case, tolerance = (
                (replace(self.case, certificate=certificate), self.tolerance)
                if files.config == self.config
                else described(files.config, certificate)
            )
            with patch.object(claims, "judged", claims.judged if whole else until_one_is_not_shown):
                return any(claim.verdict != "holds" for claim in claims.check(case, tolerance))
        except (SparseRobError, NotShown):
            return True


class NotShown(Exception):
    """A claim of a certificate is not shown."""


def until_one_is_not_shown(name: str, derive: Callable[[], str]) -> Finding:
    found = JUDGED(name, derive)
    if found.verdict != "holds":
        raise NotShown
    return found


def described(config: dict[str, Any], certificate: dict[str, Any]) -> tuple[Case, float | None]:
    loaded = load_config(config)
    problem = problem_of(loaded)
    assert isinstance(problem, sr.OptimalControlProblem)
    return Case(problem, *dictionaries_of(loaded, problem.horizon), certificate), gap_tolerance(loaded)


@pytest.fixture(scope="module")
def honest(runs: Runs) -> Callable[[str], Honest]:
    made: dict[str, Honest] = {}

    def by_name(name: str) -> Honest:
        if name not in made:
            made[name] = Honest.of(runs(name))
        return made[name]

    return by_name


def refused(directory: Path) -> bool:
    """Whether a run is not accepted: a claim is not shown, or the input is at fault. Anything but these is an error of
    the test."""
    try:
        return check(directory).status != "verified"
    except SparseRobError:
        return True


GROUPS = {
    "the decision": DECISION,
    "the figures": FIGURES,
    "the multipliers": MULTIPLIERS,
    "the proofs": PROOF,
    "the config": CONFIG,
    "the witness": WITNESS,
    "nonsense": NONSENSICAL,
    **SUBTLE,
}


@pytest.mark.first(3)
@pytest.mark.parametrize(
    "group", [pytest.param(name, marks=pytest.mark.slow if name == "nonsense" else ()) for name in GROUPS]
)
def test_no_forgery_is_accepted_even_where_all_files_agree_with_it(group: str, honest: Callable[[str], Honest]) -> None:
    accepted = [
        kind for kind, (name, change) in GROUPS[group].items() if not honest(name).refuses(change, group == "nonsense")
    ]
    assert accepted == []


@pytest.mark.first(12)
@pytest.mark.parametrize("kind", [*FILES, *CRUDE])
def test_a_crude_forgery_of_the_files_is_refused(kind: str, runs: Runs, tmp_path: Path) -> None:
    name, change = {**KINDS, **FILES}[kind]
    assert refused(forged(runs(name), tmp_path / "forged", change, consistent=False))


def test_there_are_many_kinds_of_forgery() -> None:
    assert len(KINDS) + len(FILES) >= 160
    assert sum(map(len, SUBTLE.values())) >= 100


@pytest.mark.parametrize("kind", [*CONFIG][::5])
def test_a_changed_config_no_longer_has_the_recorded_digest(kind: str, runs: Runs, tmp_path: Path) -> None:
    name, change = CONFIG[kind]
    directory = forged(runs(name), tmp_path / "forged", change, consistent=False)
    try:
        found = check(directory)
    except SparseRobError:
        return
    if kind != "the gap may be larger, in the certificate":
        assert found.claims[0].name == "config"
        assert found.claims[0].verdict == "fails"


@pytest.mark.slow
def test_a_copy_that_was_only_rewritten_is_verified(runs: Runs, tmp_path: Path) -> None:
    for name in CONFIGS:
        assert check(forged(runs(name), tmp_path / name, lambda files: None, consistent=True)).status == "verified"


def test_what_nothing_was_compared_with_is_named_and_changes_no_verdict(runs: Runs, tmp_path: Path) -> None:
    directory = forged(runs("known"), tmp_path / "forged", lambda files: files.result.update(own="word"), False)
    (directory / "notes.txt").write_text("certified, I swear")
    found = check(directory)
    assert found.status == "verified"
    named = dict(one.partition(": ")[::2] for one in found.not_compared)
    assert {"message", "seconds", "counts", "own"} <= set(named["result.json"].split(", "))
    assert not {"status", "cost", "worst", "sparsity", "gap", "seed"} & set(named["result.json"].split(", "))
    assert {"indices", "multipliers", "times"} <= set(named["solution.npz"].split(", "))
    assert {"notes.txt", "trace.npz", "rounds.npz"} <= set(named)


@pytest.mark.first(4)
@pytest.mark.parametrize(
    ("name", "change", "place"),
    [
        ("refuted", entry(proof={"path": {"tolerance": 1e-9}}), "proof"),
        ("infeasible", entry(witness={"time": 1.0}), "witness"),
        ("infeasible", entry(cost=1.0), "cost"),
        ("known", entry(witness={"time": 1.0}), "witness"),
        ("known", lambda files: files.multipliers.update(pieces=[[0.0]]), "multipliers.pieces"),
        ("walsh", lambda files: files.heaviest.update(weight=1.0), "multipliers.constraints.weight"),
        ("ellipsoidal", lambda files: files.proof("terminal").update(kind="round"), "proof.terminal.kind"),
        ("refuted", lambda files: files.certificate["witness"].update(by="search"), "witness.by"),
    ],
)
def test_what_a_certificate_says_besides_what_its_claims_rest_on_is_named(
    name: str, change: Change, place: str, runs: Runs, tmp_path: Path
) -> None:
    found = check(forged(runs(name), tmp_path / "forged", change, consistent=False))
    assert found.status == "verified"
    named = dict(one.partition(": ")[::2] for one in found.not_compared)
    assert place in named["certificate.json"].split(", ")
    honest = dict(one.partition(": ")[::2] for one in check(runs(name)).not_compared)
    assert place not in honest.get("certificate.json", "").split(", ")


def test_a_check_stops_in_time_with_what_was_decided(runs: Runs, command: Callable[..., Any]) -> None:
    found = check(runs("known"), seconds=1e-9)
    verdicts = {claim.name: claim.verdict for claim in found.claims}
    assert found.status == "undecided"
    assert verdicts["path"] == verdicts["lower bound"] == verdicts["status"] == "not checked"
    assert verdicts["cost"] == verdicts["config"] == "holds"
    assert check(runs("known"), seconds=60).status == "verified"
    for wrong in (0, -1.0, float("nan"), "10", True):
        with pytest.raises(sr.InputError, match="seconds"):
            check(runs("known"), seconds=wrong)  # type: ignore[arg-type]
    late = command("check", runs("known"), "--seconds", "1e-9")
    assert late.returncode == 4
    assert "the time limit of 1e-09 s was reached" in late.stdout


def test_a_truncated_certificate_is_an_input_error(runs: Runs, tmp_path: Path) -> None:
    directory = forged(runs("known"), tmp_path / "forged", lambda files: None, consistent=True)
    file = directory / "certificate.json"
    whole = file.read_text()
    for text in (whole[:-10], "", "[]", "1", "null", "[" * 100_000):
        file.write_text(text)
        with pytest.raises(sr.InputError, match=r"certificate\.json"):
            check(directory)
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(sr.InputError, match=r"certificate\.json"):
        check(directory)


def test_the_command_ends_with_a_status_for_scripts(runs: Runs, tmp_path: Path, command: Callable[..., Any]) -> None:
    honest = command("check", runs("known"))
    assert (honest.returncode, honest.stderr) == (0, "")
    assert "verified" in honest.stdout
    name, change = KINDS["the lower bound is as high as the cost"]
    false = command("check", forged(runs(name), tmp_path / "forged", change, consistent=True), "--json")
    assert (false.returncode, json.loads(false.stdout)["status"]) == (4, "refuted")
    nothing = command("check", tmp_path)
    assert nothing.returncode == 2
    assert "expected the directory of a run" in nothing.stderr
    assert "Traceback" not in nothing.stderr
