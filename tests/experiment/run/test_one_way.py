"""Guards that a run with feedback and one without go one way, from transcription to `check`: they enter the same
functions, but for what answers are, and for what is claimed of one of them alone."""

from __future__ import annotations

import copy
from functools import partial
from pathlib import Path

import sparserob_core as sr
from tests.support.entered import entered
from tests.support.problems import spring

PLACES = (
    "sip/methods/",
    "control/transcription/",
    "experiment/directory/certificate.py",
    "experiment/run/journal.py",
    "experiment/run/run.py",
    "checker/claims/",
)
# how few pieces can act is claimed of a control that answers nothing, whose families have rows of the decision and
# whose last digits are chosen such that it lands
# and the checker's loops of what does not change with time do not go through its flow yet
ALONE = {
    "checker.claims.case.Case.flows",
    "checker.claims.case.Case.states",
    "checker.claims.activity.",
    "checker.claims.claims._describe_least_share",
    "checker.claims.claims._verify_fewest_active",
    "checker.claims.claims._replace_control",
    "checker.claims.constraints.tubes",
    "control.transcription.program.OpenLoopModel.",
    "control.transcription.program._block_units",
    "control.transcription.program._build_reduced_family",
    "control.transcription.program._land",
    "control.transcription.program.family_of",
    "sip.methods.fewest.",
}
# answers, the deviations that they answer, the policy itself, and the bound against every causal policy
ANSWERING = {
    "checker.claims.answers.",
    "checker.claims.case.Case.answers",
    "checker.claims.case.written_policy",
    "checker.claims.causal.",
    "checker.claims.claims._verify_causal_bound",
    "checker.claims.claims._verify_policy",
    "checker.claims.claims.derived_causal_bound",
    "checker.claims.multipliers._answer",
    "control.transcription.feedback.",
    "control.transcription.program.held_nominally",
    "control.transcription.record.Transcription.",
    "control.transcription.transcribe._build_inner_loop",
    "experiment.directory.certificate._write_disturbance",
    "experiment.directory.certificate._write_deviations",
    "experiment.directory.certificate._move_inside",
    "experiment.directory.certificate._find_ranges",
    "experiment.directory.certificate.causal_data",
}


def whole(policy: str, place: Path) -> None:
    """A run, and its check."""
    config = {
        "problem": spring(0.05, since=0.5),
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 4}},
        "policy": {"name": policy},
        "observers": [],
    }
    assert sr.run(copy.deepcopy(config), out=place, quiet=True, figures=False).status == "certified"
    assert sr.check(place).status == "verified"


def beyond(functions: set[str], named: set[str]) -> list[str]:
    """Those that none of the names is the beginning of."""
    return sorted(one for one in functions if not one.startswith(tuple(named)))


def test_a_run_with_feedback_and_one_without_go_one_way(tmp_path: Path) -> None:
    whole("open_loop", tmp_path / "first")  # whatever is done once in a process
    plain, answering = (
        entered(partial(whole, policy, tmp_path / policy), *PLACES)[1] for policy in ("open_loop", "affine")
    )
    assert beyond(plain - answering, ALONE) == []
    assert beyond(answering - plain, ANSWERING) == []
    shared = plain & answering
    assert len(shared) > 0.9 * len(plain)
    for one in (
        "sip.methods.driver.drive",
        "sip.methods.exchange.Rounds.step",
        "control.transcription.transcribe.prepare",
        "control.transcription.transcribe._build_own_units",
        "control.transcription.program.build_program",
        "control.transcription.program.compute_conversion_factors",
        "control.transcription.telling.Telling.family",
        "checker.claims.multipliers._derive_base_row",
        "checker.claims.constraints.bounded",
    ):
        assert one in shared, sorted(shared)
