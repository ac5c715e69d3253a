"""Guards speed: what a certificate costs: the run's own proof and the file, and the independent check, beside the solve
that they are about."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

import sparserob_core as sr
from tests.support.places import CONFIGS

pytestmark = pytest.mark.benchmark


@pytest.mark.parametrize(
    "name", ["experiment1_repaired", "experiment3_repaired", "coupled_masses", "double_integrator"]
)
def test_the_proof_of_a_known_system_takes_no_longer_than_solving(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from sparserob_core.experiment.directory.certificate import certificate

    outcome = sr.run(CONFIGS / f"{name}.yaml", out=tmp_path / "first", quiet=True, figures=False)  # imports, caches
    outcome = sr.run(CONFIGS / f"{name}.yaml", out=tmp_path / "run", quiet=True, figures=False)
    proving = min(proof_seconds(outcome) for _ in range(3))
    writing = least(lambda: certificate(outcome.experiment, outcome.result))
    checking = least(lambda: sr.check(tmp_path / "run"))
    solving = outcome.result.seconds - min(proving, 0.5 * outcome.result.seconds)
    with capsys.disabled():
        print(
            f"\n{name}: solve {solving:.3f} s; as shares of it: proof {proving / solving:.2f}, certificate"
            f" {writing / solving:.2f}, independent check {checking / solving:.2f}"
        )
    assert proving + writing <= solving


def proof_seconds(outcome: sr.Outcome) -> float:
    """The proof of the decision on a program that has separated it before, as in a run, and remembers nothing else."""
    from sparserob_core.experiment.assemble import ControlExperiment
    from sparserob_core.sip.proof.branch_and_bound import prove

    experiment = outcome.experiment
    assert isinstance(experiment, ControlExperiment) and outcome.result.decision is not None
    program = sr.transcribe(experiment.problem, control=experiment.control, disturbance=experiment.disturbance)
    for family in program.families:
        assert family.worst is not None
        family.worst(outcome.result.decision)
    started = time.perf_counter()
    prove(program, outcome.result.decision)
    return time.perf_counter() - started


def least(action: object, times: int = 3) -> float:
    """The shortest of a few durations, in seconds."""
    assert callable(action)
    spent = []
    for _ in range(times):
        started = time.perf_counter()
        action()
        spent.append(time.perf_counter() - started)
    return min(spent)
