"""``sparserob check``: a finished run verified anew, from its config and its certificate alone."""

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
    from sparserob_core.experiment.run.given import GivenRun

REPEATED = 16  # times that a number may be written, in characters: honest files need 7; what more allows takes memory
SPARE = 2**20  # bytes of what is neither in certificate nor config, some kB; ten times as many are no matter either
STATUS = {"holds": 0, "not checked": 1, "fails": 2}


@final
@dataclass(frozen=True)
class Check:
    """The verdicts on a run, one per claim. ``status`` is ``verified`` when all hold, ``refuted`` when one fails, else
    ``undecided``. ``not_compared``: what the files say besides that nothing was compared with, which changes no
    verdict."""

    title: str
    claims: tuple[Finding, ...]
    seconds: float
    not_compared: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """The verdict first, then the claims that do not hold; those that hold are counted."""
        doubtful = [one for one in self.claims if one.verdict != "holds"]
        lines = [f"Check: {self.status}", f"  title: {self.title}", f"  {len(self.claims) - len(doubtful)} claims hold"]
        lines += [f"  {one.name} {one.verdict}: {one.text}" for one in doubtful]
        return shortened([*lines, f"  seconds: {self.seconds:.3g}"])

    @property
    def status(self) -> str:
        worst = max((STATUS[claim.verdict] for claim in self.claims), default=1)
        return ("verified", "undecided", "refuted")[worst]


def check(directory: GivenRun, plugins: Iterable[str | Path] = (), seconds: float = math.inf) -> Check:
    """Verify a finished run (`as_run`): its certificate against its config in ball arithmetic, ``result.json`` and
    ``solution.npz`` against both.

    Nothing is solved, and nothing of what solved it is used. ``plugins``: files that offer the problem or a dictionary
    where these are no part of this distribution; the directory itself is data, and no plugin that it names is loaded.
    After ``seconds`` what was decided is returned, and the rest is ``not checked``. Raises `InputError` when the
    directory is not that of a finished run with a certificate, or ``seconds`` are not positive.
    """
    from sparserob_core.checker.claims.case import Case
    from sparserob_core.checker.claims.claims import check as derive
    from sparserob_core.experiment.assemble import control_problem_of, counting, dictionaries_of, gap_tolerance

    if type(seconds) not in (int, float) or not seconds > 0:
        raise InputError(path="seconds", expected="a positive number", got=repr(seconds))
    started, clock, path = time.perf_counter(), Clock(float(seconds)), _place(directory)
    if (path / "bound.json").is_file():
        return _worst_cases(path, plugins, clock, started)
    stored = stored_run(path)
    if not (path / "certificate.json").is_file():
        raise InputError(f"{path}: expected the directory of a finished run, got one without certificate.json")
    data, summary = read_json(path / "certificate.json"), read_json(path / "result.json")
    loaded = stored.config(plugins)
    problem = control_problem_of(loaded, f"{path}: expected the run of a control problem, whose certificate is checked")
    control, disturbance = dictionaries_of(loaded, problem.horizon)
    policy = _policy(loaded, data, control, problem.measurements)
    title = loaded.config.title or path.name
    try:
        case = Case(problem, control, disturbance, data, clock, *counting(loaded), policy)
    except Unchecked as gap:
        return _of_no_case(title, gap, started)
    derived = derive(case, gap_tolerance(loaded))
    files = compared(replace(stored, largest=_largest(path, case)), loaded, case, summary)
    claims = (_config(loaded, data, summary), *derived, *files.claims)
    return Check(title, claims, time.perf_counter() - started, files.not_compared)


def _of_no_case(title: str, gap: Unchecked, started: float) -> Check:
    """Of a problem that the checker cannot state."""
    return Check(title, (Finding("problem", "not checked", str(gap)),), time.perf_counter() - started)


def _worst_cases(path: Path, plugins: Iterable[str | Path], clock: Clock, started: float) -> Check:
    """The verdicts on the directory that `bound` wrote."""
    from sparserob_core.checker.claims.case import Case
    from sparserob_core.checker.suprema.suprema import check_suprema
    from sparserob_core.experiment.assemble import control_problem_of, dictionaries_of

    data = read_json(path / "bound.json")
    loaded = read_config(path, plugins)
    problem = control_problem_of(loaded, f"{path}: expected worst cases of a control problem")
    control, disturbance = dictionaries_of(loaded, problem.horizon)
    decision = data.get("decision")
    if decision is None:  # without any control
        data = {**data, "decision": [[0.0] * control.functions for _ in range(problem.system.controls)]}
    title = loaded.config.title or path.name
    try:
        case = Case(problem, control, disturbance, data, clock)
    except Unchecked as gap:
        return _of_no_case(title, gap, started)
    claims = check_suprema(case)
    rest = tuple(name for name in ("envelopes.npz", "bound.png") if (path / name).is_file())
    return Check(title, (_config(loaded, data, data), *claims), time.perf_counter() - started, rest)


def _policy(
    loaded: Loaded, data: Mapping[str, Any], control: Dictionary, measured: Measurements | None
) -> Policy | None:
    """The policy of a config where it answers anything. Of one whose component is not at hand, what the certificate
    says of it: what is claimed is claimed of such policies."""
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
        except Broken:  # nothing is written, or the claim `policy` says what is wrong
            return None
    return policy if answers_of(policy, control.breakpoints, measured).any() else None


def _place(run: GivenRun) -> Path:
    """The directory of a run; what knows runs is imported only where one was given, as a check is of a directory."""
    if isinstance(run, str | Path):
        return Path(run)
    from sparserob_core.experiment.run.given import as_run

    return as_run(run)[0]


def _largest(directory: Path, case: Case) -> int:
    """How many bytes the arrays of ``solution.npz`` may take: they hold what certificate and config say a few times
    over (8 bytes for a number that has at least 3 characters), and the control on its pieces."""
    said = sum((directory / name).stat().st_size for name in ("certificate.json", "config.yaml"))
    return SPARE + REPEATED * (said + 8 * case.control.pieces * case.problem.system.controls)


def _config(loaded: Loaded, data: Mapping[str, Any], summary: Mapping[str, Any]) -> Finding:
    """An earlier version had fewer keys: the digest is of the config as it is read today, or as it is written."""
    found, written = loaded.config.digest(), digest(loaded.source.data)
    if data.get("config") not in (found, written) or summary.get("config") != data.get("config"):
        return Finding(
            "config",
            "fails",
            f"config.yaml is {found}, the certificate is about {data.get('config')!r}, "
            f"result.json about {summary.get('config')!r}",
        )
    return Finding("config", "holds", f"the certificate is about this config ({data['config']})")
