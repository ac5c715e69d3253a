"""The two usual ways to deal with uncertainty, kept honest: their decisions are judged against every uncertainty, like
any other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from pydantic import Field

from sparserob_core.errors import InputError
from sparserob_core.options import Options
from sparserob_core.sip.events import RoundFinished, forward_events
from sparserob_core.sip.method import GAP_TOLERANCE, Method, Tools
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.program import TOLERANCE, ConstraintFamily, SemiInfiniteProgram
from sparserob_core.sip.proof.branch_and_bound import prove
from sparserob_core.sip.proof.verdict import include_found_violation, verdict, witness, worst_of
from sparserob_core.sip.result import Result, relative_gap
from sparserob_core.sip.scenario_bound import scenario_bound
from sparserob_core.sip.separation.separation import separate
from sparserob_core.sip.working.ledger import alarm, prove_nothing


class Nominal(Method, Options):
    """Solve as if nothing were uncertain, to the relative gap ``tolerance``; then judge the decision against the
    uncertainty."""

    tolerance: float = Field(default=GAP_TOLERANCE, gt=0.0, le=1.0)
    """Relative gap at which the bounds have met."""

    rounds: int = Field(default=200, ge=1)
    """Rounds at most."""

    def solve(self, program: SemiInfiniteProgram, tools: Tools) -> Result:
        return _judge_simplified(
            program,
            _simplify_families(program, "nominal", lambda family: family.nominal),
            tools,
            self.tolerance,
            self.rounds,
        )


class Scenario(Method, Options):
    """Impose the constraints for ``scenarios`` sampled uncertainties (Calafiore and Campi 2006); then judge the
    decision against all of them.

    Beside the worst violation stands what the scenario theory promises: the `ScenarioBound` of the result. A constraint
    belongs to one scenario, so those that carry a multiplier are at least as many as the support constraints.
    """

    tolerance: float = Field(default=GAP_TOLERANCE, gt=0.0, le=1.0)
    """Relative gap at which the bounds have met."""

    rounds: int = Field(default=200, ge=1)
    """Rounds at most."""

    scenarios: int = Field(default=1000, ge=1)
    """How many uncertainties are sampled."""

    def solve(self, program: SemiInfiniteProgram, tools: Tools) -> Result:
        result = _judge_simplified(program, self.simplified(program, tools.rng), tools, self.tolerance, self.rounds)
        if result.decision is None:
            return result
        bound = scenario_bound(self.scenarios, program.n, len(result.indices))
        message = f"{result.message}; {bound.sentence}" if result.status in ("refuted", "undecided") else result.message
        return replace(result, message=message, scenario_bound=bound)

    def simplified(self, program: SemiInfiniteProgram, rng: np.random.Generator) -> SemiInfiniteProgram:
        """The program with the scenarios only that are drawn by ``rng``; raises `InputError`."""
        seed = int(rng.integers(2**63))  # every family sees the same scenarios

        def sampled(family: ConstraintFamily) -> ConstraintFamily | None:
            return None if family.sample is None else family.sample(self.scenarios, np.random.default_rng(seed))

        return _simplify_families(program, "scenario", sampled)


def _simplify_families(
    program: SemiInfiniteProgram, method: str, simpler: Callable[[ConstraintFamily], ConstraintFamily | None]
) -> SemiInfiniteProgram:
    families = [simpler(family) for family in program.families]
    missing = [family.name for family, simple in zip(program.families, families, strict=True) if simple is None]
    if missing:
        raise InputError(
            f"method: {method} needs families that tell their uncertainty apart, which {', '.join(missing)} does not; "
            "expected the method exchange"
        )
    return replace(program, families=[family for family in families if family is not None])


def _judge_simplified(
    program: SemiInfiniteProgram, simple: SemiInfiniteProgram, tools: Tools, tolerance: float, rounds: int
) -> Result:
    """Solve the simpler program, whose lower bound holds for the full one too, and say what its decision is worth in
    the full one."""
    notify = forward_events(tools.notify, RoundFinished, lambda event: replace(event, simplified=True))
    method = Exchange(tolerance=tolerance, rounds=rounds)
    result = method.close(simple, replace(tools, notify=notify), prove_nothing)  # the full one is proven below
    if result.decision is None:
        return result
    x, separations = result.decision, []
    try:
        separations = separate(program, x, tools, TOLERANCE)
    except KeyboardInterrupt as error:
        tools.deadline.interrupt(error)
    proofs = include_found_violation(prove(program, x, tools.notify, deadline=tools.deadline), separations)
    status, message = verdict(proofs, relative_gap(result.dual.bound, result.cost, result.cost_scale), tolerance)
    proven = status in ("certified", "verified")
    wrong = alarm(simple, result.dual, x) if proven else ""
    stopped = tools.deadline.reason if result.stopped or status == "undecided" else ""
    return replace(
        result,
        status="failed" if wrong else status,
        message="; ".join(sentence for sentence in (wrong or message, stopped) if sentence),
        decision=None if wrong else x,
        proofs=tuple(proofs),
        worst=witness(program, worst_of(separations), proofs),
        lower_bound=min(result.dual.bound, result.cost) if proven and not wrong else result.dual.bound,
        upper_bound=result.cost if proven and not wrong else np.inf,
        stopped=stopped,
    )
