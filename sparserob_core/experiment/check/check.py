"""The check of a finished run, from its config and its certificate alone: ``sparserob check``."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from sparserob_core.brief import shortened
from sparserob_core.checker.outcome import Clock, Finding, Unchecked
from sparserob_core.errors import InputError
from sparserob_core.experiment.check.files import compared
from sparserob_core.experiment.config.run_config import digest
from sparserob_core.experiment.directory.finished import read_config, read_json, stored_run

if TYPE_CHECKING:
    from sparserob_core.checker.claims.case import Case
    from sparserob_core.control.policies.measurements import Measurements
    from sparserob_core.control.policies.policy import Policy
    from sparserob_core.control.problem.dictionary import Dictionary
    from sparserob_core.experiment.config.load import Loaded
    from sparserob_core.experiment.directory.finished import StoredRun
    from sparserob_core.experiment.run.given import GivenRun
    from sparserob_core.sip.program import SemiInfiniteProgram

REPEATED = 16  # bytes of arrays for each character of the files: true runs need 7; a larger limit only costs memory
SPARE_BYTES = 2**20  # bytes for numbers that stand in neither certificate nor config, which are some kB
STATUS = {"holds": 0, "not checked": 1, "fails": 2}


@final
@dataclass(frozen=True)
class Check:
    """The verdicts on the claims of a run, and the conclusion from them.

    Parameters
    ----------
    title : str
        The title of the run.
    claims : tuple of Finding
        The verdict on each claim.
    seconds : float
        The seconds that the check has taken.
    not_compared : tuple of str, default ()
        The entries of the files with which nothing was compared; they change no verdict.
    """

    title: str
    claims: tuple[Finding, ...]
    seconds: float
    not_compared: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Return the status, the number of claims that hold, and the claims that do not."""
        doubtful = [claim for claim in self.claims if claim.verdict != "holds"]
        lines = [f"Check: {self.status}", f"  title: {self.title}", f"  {len(self.claims) - len(doubtful)} claims hold"]
        lines += [f"  {claim.name} {claim.verdict}: {claim.text}" for claim in doubtful]
        return shortened([*lines, f"  seconds: {self.seconds:.3g}"])

    @property
    def status(self) -> str:
        worst = max((STATUS[claim.verdict] for claim in self.claims), default=1)
        return ("verified", "undecided", "refuted")[worst]


def check(directory: GivenRun, plugins: Iterable[str | Path] = (), seconds: float = math.inf) -> Check:
    """Verify a finished run: its certificate in ball arithmetic, then its other files.

    The certificate is checked against the config, and ``result.json`` and ``solution.npz`` against both. Nothing is
    solved, and nothing that solved the run is used.

    Parameters
    ----------
    directory : str, Path, Outcome or SolvedProblem
        The run (`as_run`), or the directory of a `bound`.
    plugins : iterable of str or Path, default ()
        Files of plugins with the problem or a dictionary, where these do not belong to this distribution. The directory
        itself is data: no plugin that it names is loaded.
    seconds : float, optional
        The time after which the verdicts so far are returned; the remaining claims are ``not checked``.

    Returns
    -------
    Check
        The verdicts. The status is ``verified`` where all claims hold, ``refuted`` where one fails, else ``undecided``.

    Raises
    ------
    InputError
        If the directory is not that of a finished run with a certificate, or the ``seconds`` are not positive.
    """
    from sparserob_core.checker.claims.case import Case
    from sparserob_core.checker.claims.claims import check as derive
    from sparserob_core.experiment.assemble import counting, dictionaries_of, gap_tolerance, problem_of
    from sparserob_core.sip.program import SemiInfiniteProgram

    if type(seconds) not in (int, float) or not seconds > 0:
        raise InputError(path="seconds", expected="a positive number", got=repr(seconds))
    started, clock, path = time.perf_counter(), Clock(float(seconds)), _locate_run(directory)
    if (path / "bound.json").is_file():
        return _check_worst_cases(path, plugins, clock, started)
    stored = stored_run(path)
    if not (path / "certificate.json").is_file():
        raise InputError(f"{path}: expected the directory of a finished run, got one without certificate.json")
    data, summary = read_json(path / "certificate.json"), read_json(path / "result.json")
    loaded = stored.config(plugins)
    problem = problem_of(loaded)
    if isinstance(problem, SemiInfiniteProgram):
        return _check_program(stored, loaded, problem, data, summary, clock, started)
    control, disturbance = dictionaries_of(loaded, problem.horizon)
    policy = _find_policy(loaded, data, control, problem.measurements)
    title = loaded.config.title or path.name
    try:
        case = Case(problem, control, disturbance, data, clock, *counting(loaded), policy)
    except Unchecked as gap:
        return _report_unchecked(title, gap, started)
    derived = derive(case, gap_tolerance(loaded))
    files = compared(replace(stored, largest=_bound_array_bytes(path, case)), loaded, case, summary)
    claims = (_check_config(loaded, data, summary), *derived, *files.claims)
    return Check(title, claims, time.perf_counter() - started, files.not_compared)


def _check_program(
    stored: StoredRun,
    loaded: Loaded,
    program: SemiInfiniteProgram,
    data: Mapping[str, Any],
    summary: Mapping[str, Any],
    clock: Clock,
    started: float,
) -> Check:
    """Return the verdicts on the run of a program that was stated as text."""
    from sparserob_core.checker.program.claims import ProgramCase, check_program
    from sparserob_core.experiment.assemble import gap_tolerance
    from sparserob_core.experiment.check.files import compare_program
    from sparserob_core.sip.stated.statement import StatedProgram

    if not isinstance(program.origin, StatedProgram):
        raise InputError(f"{stored.directory}: expected a problem that is stated as data, got a program of a plugin")
    derived = check_program(ProgramCase(program.origin, data, clock), gap_tolerance(loaded))
    files = compare_program(stored, data, summary, program.n)
    claims = (_check_config(loaded, data, summary), *derived, *files.claims)
    title = loaded.config.title or stored.directory.name
    return Check(title, claims, time.perf_counter() - started, files.not_compared)


def _report_unchecked(title: str, gap: Unchecked, started: float) -> Check:
    """Return the check of a problem that the checker cannot describe."""
    return Check(title, (Finding("problem", "not checked", str(gap)),), time.perf_counter() - started)


def _check_worst_cases(path: Path, plugins: Iterable[str | Path], clock: Clock, started: float) -> Check:
    """Return the verdicts on a directory that `bound` wrote."""
    from sparserob_core.checker.claims.case import Case
    from sparserob_core.checker.suprema.suprema import check_suprema
    from sparserob_core.experiment.assemble import control_problem_of, dictionaries_of

    data = read_json(path / "bound.json")
    loaded = read_config(path, plugins)
    problem = control_problem_of(loaded, f"{path}: expected worst cases of a control problem")
    control, disturbance = dictionaries_of(loaded, problem.horizon)
    decision = data.get("decision")
    if decision is None:  # the worst cases were bounded without a control
        data = {**data, "decision": [[0.0] * control.functions for _ in range(problem.system.controls)]}
    title = loaded.config.title or path.name
    try:
        case = Case(problem, control, disturbance, data, clock)
    except Unchecked as gap:
        return _report_unchecked(title, gap, started)
    claims = check_suprema(case)
    not_compared = tuple(name for name in ("envelopes.npz", "bound.png") if (path / name).is_file())
    return Check(title, (_check_config(loaded, data, data), *claims), time.perf_counter() - started, not_compared)


def _find_policy(
    loaded: Loaded, data: Mapping[str, Any], control: Dictionary, measured: Measurements | None
) -> Policy | None:
    """Return the policy of a config; ``None`` where it answers no measurement.

    Where its component is not registered, the policy is that which the certificate describes, for that is the policy of
    its claims. It is ``None`` where the certificate describes none.
    """
    from sparserob_core.checker.claims.case import written_policy
    from sparserob_core.checker.outcome import Broken
    from sparserob_core.control.policies.policy import answers_of
    from sparserob_core.experiment.assemble import build

    entry = loaded.config.policy
    policy: Policy
    if entry.name in loaded.registry.names("policy"):
        policy = build(loaded, "policy", entry)
    else:
        try:
            policy = written_policy(data, control.pieces)
        except Broken:  # there is no policy in the certificate, or the claim `policy` fails with the reason
            return None
    return policy if answers_of(policy, control.breakpoints, measured).any() else None


def _locate_run(run: GivenRun) -> Path:
    """Return the directory of a run.

    The module that knows runs is imported only where a run was given: a check is mostly of a directory.
    """
    if isinstance(run, str | Path):
        return Path(run)
    from sparserob_core.experiment.run.given import as_run

    return as_run(run)[0]


def _bound_array_bytes(directory: Path, case: Case) -> int:
    """Return the largest number of bytes that the arrays of ``solution.npz`` may take.

    They repeat the numbers of certificate and config a few times (8 bytes for a number of at least 3 characters), and
    hold the control on its pieces.
    """
    file_bytes = sum((directory / name).stat().st_size for name in ("certificate.json", "config.yaml"))
    return SPARE_BYTES + REPEATED * (file_bytes + 8 * case.control.pieces * case.problem.system.controls)


def _check_config(loaded: Loaded, data: Mapping[str, Any], summary: Mapping[str, Any]) -> Finding:
    """Return the verdict on the claim that certificate and config belong together.

    An earlier version knew fewer keys, so that the digest may be that of the config as it is read today or as it is
    written.
    """
    resolved_digest, source_digest = loaded.config.digest(), digest(loaded.source.data)
    if data.get("config") not in (resolved_digest, source_digest) or summary.get("config") != data.get("config"):
        return Finding(
            "config",
            "fails",
            f"config.yaml is {resolved_digest}, the certificate is about {data.get('config')!r}, "
            f"result.json about {summary.get('config')!r}",
        )
    return Finding("config", "holds", f"the certificate is about this config ({data['config']})")
