"""Guards experiment/plugins, attribution and guards: whatever a foreign component does, one error names it; nothing is
lost, and nothing ends with exit status 0."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.cli.main import _run_command_line

HEAD = "import sys\nimport numpy as np\nimport sparserob_core as sr\n"
KINDS = {
    "dictionary": ("DictionaryFactory", "sparserob_dictionaries", "DictionaryPlugin", "def build(self, horizon)"),
    "regulariser": ("Regulariser", "sparserob_regularisers", "RegulariserPlugin", "def quadratic(self, image)"),
    "solver": ("Solver", "sparserob_solvers", "SolverPlugin", "def solve(self, program, accuracy)"),
    "maximiser": ("Maximiser", "sparserob_maximisers", "MaximiserPlugin", "def search(self, objective, rng)"),
    "method": ("Method", "sparserob_methods", "MethodPlugin", "def solve(self, program, tools)"),
    "problem": ("ProblemFactory", "sparserob_problems", "ProblemPlugin", "def build(self)"),
    "inner_stop": ("InnerStop", "sparserob_rules", "RulePlugin", "def __call__(self, progress)"),
    "outer_stop": ("OuterStop", "sparserob_rules", "RulePlugin", "def __call__(self, steps)"),
    "schedule": ("Schedule", "sparserob_rules", "RulePlugin", "def __call__(self, epsilon, j)"),
    "selection": (
        "Selection", "sparserob_rules", "RulePlugin", "def __call__(self, now, candidate, temperature, rng)",
    ),
}  # fmt: skip
SPARSEROB = {"name": "sparserob", "indices": 2}
WALK = {"maximiser": {"name": "simulated_annealing", "budget": 40}, "method": SPARSEROB}
CHOSEN = {
    "dictionary": {"dictionaries": {"control": "odd"}},
    "regulariser": {"regulariser": "odd"},
    "maximiser": {"maximiser": "odd", "method": SPARSEROB},
    "method": {"method": "odd"},
    "problem": {"problem": {"name": "odd"}},
    "inner_stop": {**WALK, "method": {**SPARSEROB, "sc2": "odd"}},
    "outer_stop": {**WALK, "method": {**SPARSEROB, "sc1": "odd"}},
    "schedule": {**WALK, "method": {**SPARSEROB, "regu": "odd"}},
    "selection": {**WALK, "method": {**SPARSEROB, "slcr": "odd"}},
}  # fmt: skip
PROBLEM = {
    "name": "linear", "horizon": 1.0, "system": {"A": [[0.0]], "B": [[1.0]]}, "initial_state": [1.0],
    "control": {"box": 4.0}, "path": [{"box": 2.0}], "terminal": [{"box": 0.1}],
}  # fmt: skip
ZEROS = "np.zeros(len(program.q)), np.zeros(len(program.h)), np.zeros(len(program.b)), np.zeros(len(program.q))"
MISBEHAVIOURS = [
    ("dictionary", "return None", "build returned None, expected a Dictionary"),
    ("dictionary", "raise KeyError('z')", "build raised KeyError: 'z'"),
    ("dictionary", "raise SystemExit(0)", "build raised SystemExit: 0"),
    ("dictionary", "return sr.Dictionary([0.0, 9.0], [[1.0]])", r"on \[0.0, 9.0\], expected \[0, 1.0\]"),
    ("dictionary", "return np.zeros(3)", "build returned array"),
    ("dictionary", "return horizon.length", "build raised AttributeError"),
    ("regulariser", "return None", "quadratic returned None, expected a tuple"),
    ("regulariser", "return ('a', 'b')", "quadratic: what it returned raised"),
    ("regulariser", "return np.eye(3), np.zeros(3)", r"quadratic returned shapes \(3, 3\) and \(3,\), expected \(100"),
    ("regulariser", "return np.eye(100), np.full(100, np.nan)", "quadratic returned numbers that are not finite"),
    ("regulariser", "raise SystemExit", "quadratic raised SystemExit"),
    ("regulariser", "1 / 0", "quadratic raised ZeroDivisionError: division by zero"),
    ("maximiser", "return None", "search returned None, expected an upper bound"),
    ("maximiser", "raise RuntimeError('mmm')", "search raised RuntimeError: mmm"),
    ("maximiser", "raise SystemExit(0)", "search raised SystemExit: 0"),
    ("maximiser", "objective.evalute(1)", "search raised AttributeError: .*evalute"),
    ("maximiser", "objective.evaluate(objective.domain.upper[None] + 9)", "points: .* lies outside the domain"),
    ("maximiser", "objective.evaluate(np.zeros((1, 99)))", r"points: expected shape \(k, "),
    ("maximiser", "return objective.best_value - 1.0", "claims the upper bound"),
    ("maximiser", "return float('nan')", "claims the upper bound nan"),
    ("method", "return None", "solve returned None, expected a Result"),
    ("method", "raise SystemExit(0)", "solve raised SystemExit: 0"),
    ("method", "raise IndexError('i')", "solve raised IndexError: i"),
    ("method", "return sr.Result(status='fine', message='')", "the status 'fine', expected one of certified"),
    ("method", "return sr.Result(status='failed', message='', decision=np.ones(3))", "the decision arr.*expected 100"),
    ("problem", "return None", "build returned None, expected an OptimalControlProblem or"),
    ("problem", "raise MemoryError", "build raised MemoryError"),
    ("problem", "raise SystemExit(0)", "build raised SystemExit: 0"),
    ("inner_stop", "return None", "calling it returned None, expected true or false"),
    ("inner_stop", "raise SystemExit(0)", "calling it raised SystemExit: 0"),
    ("outer_stop", "return 'yes'", "calling it returned 'yes', expected true or false"),
    ("outer_stop", "return steps[7].cost", "calling it raised IndexError"),
    ("schedule", "return None", "calling it returned None, expected a number"),
    ("schedule", "raise SystemExit(0)", "calling it raised SystemExit: 0"),
    ("selection", "return None", "calling it returned None, expected true or false"),
    ("selection", "raise SystemExit(0)", "calling it raised SystemExit: 0"),
]  # fmt: skip


def plugin(kind: str, body: str) -> str:
    base, hook, record, signature = KINDS[kind]
    return (
        f"{HEAD}class Odd(sr.{base}, sr.Options):\n    {signature}:\n        {body}\n"
        f"@sr.hookimpl\ndef {hook}():\n    yield sr.{record}(name='odd', factory=Odd)\n"
    )


@pytest.fixture
def status(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """Run a config with a plugin as the command does: the exit status, and what it says."""

    def run(text: str, chosen: dict[str, object]) -> tuple[int, str]:
        (tmp_path / "odd.py").write_text(text)
        config = {"problem": PROBLEM, "observers": [], "plugins": ["odd.py"], **chosen}
        (tmp_path / "odd.yaml").write_text(json.dumps(config))
        code = _run_command_line(["run", str(tmp_path / "odd.yaml"), "--out", str(tmp_path / "run"), "--no-figures"])
        said = capsys.readouterr()
        return code, said.out + said.err

    return run


@pytest.mark.first(18)
@pytest.mark.parametrize(("kind", "body", "words"), MISBEHAVIOURS)
def test_a_component_that_misbehaves_is_named_and_ends_with_status_5(kind, body, words, status, tmp_path) -> None:
    code, said = status(plugin(kind, body), CHOSEN[kind])
    flat = " ".join(said.split())
    hook = KINDS[kind][1]
    kind = "rule" if hook == "sparserob_rules" else kind
    assert code == 5, said
    assert f"{kind} 'odd' (plugin 'odd', {tmp_path / 'odd.py'}, hook {hook}): " in flat
    assert re.search(words, flat), flat
    assert "internal error" not in flat
    assert "Traceback" not in flat


@pytest.mark.parametrize("claimed", ["certified", "infeasible", "undecided"])
def test_what_a_method_of_others_claims_is_said_to_be_believed(claimed, status, tmp_path) -> None:
    body = f"return sr.Result(status='{claimed}', message='so it is', decision=np.zeros(program.n))"
    (tmp_path / "odd.py").write_text(plugin("method", body))
    method = sr.load_registry([tmp_path / "odd.py"]).build("method", "odd")
    result = sr.solve(sr.SemiInfiniteProgram(n=1, q=[1.0], lower=0.0), method=method)
    believed = "" if claimed == "undecided" else "; what the method Odd claims is believed"
    assert result.message == f"so it is{believed}"


SOLVERS = [
    ("return 1", "solve returned 1, expected a Claim"),
    ("raise SystemExit(0)", "solve raised SystemExit: 0"),
    ("raise RuntimeError('boom')", "solve raised RuntimeError: boom"),
    (f"return sr.Claim('done', {ZEROS})", "solve claimed 'done', expected solved, infeasible or failed"),
    ("return sr.Claim('solved', None, None, None, None)", "solve claimed x = None"),
    (f"return sr.Claim('solved', {ZEROS.replace('np.zeros(len(program.q))', 'np.zeros(1)', 1)})", "solve claimed x ="),
]


@pytest.mark.first(3)
@pytest.mark.parametrize(("body", "words"), SOLVERS)
def test_a_solver_that_misbehaves_is_named_in_the_answer(body, words, tmp_path) -> None:
    """A solver may fail on a program: another one answers, and the result names the first with what it did."""
    (tmp_path / "odd.py").write_text(plugin("solver", body))
    solver = sr.load_registry([tmp_path / "odd.py"]).build("solver", "odd")
    program = sr.SemiInfiniteProgram(
        n=2, P=[[2.0, 1.0], [1.0, 2.0]], q=[-1.0, -1.0],
        families=[sr.ConstraintFamily(
            name="below", index_set=sr.Box([0.0], [1.0]),
            rows=lambda t: (np.ones((len(t), 1, 2)), t * 0 + 0.1),
        )],
    )  # fmt: skip
    result = sr.solve(program, solver=solver)
    assert result.value == pytest.approx(-0.0925, abs=1e-9), "x1 + x2 = 0.1"
    (missed,) = result.unanswered
    assert missed.by == "piqp"
    assert missed.count == result.counts["relaxed_programs"]
    assert re.search(rf"solver .dd.*{words}", missed.reason), missed.reason


MODULES = [
    ("sys.exit(0)", "loading it raised SystemExit: 0"),
    ("raise ValueError('v')", "loading it raised ValueError: v"),
    ("import not_there", "loading it raised ModuleNotFoundError"),
    ("sr.Box([1.0], [0.0])", "loading it raised InputError"),
    ("@sr.hookimpl\ndef sparserob_solvers():\n    sys.exit(0)", "hook sparserob_solvers raised SystemExit: 0"),
    ("@sr.hookimpl\ndef sparserob_solvers():\n    return 3", "hook sparserob_solvers raised TypeError"),
    ("@sr.hookimpl\ndef sparserob_solvers():\n    yield None", "sparserob_solvers yielded None, expected records"),
    ("@sr.hookimpl\ndef sparserob_regularisers():\n    yield sr.RegulariserPlugin(name='odd', factory=sys.exit)",
     "building it raised SystemExit"),
    ("@sr.hookimpl\ndef sparserob_regularisers():\n    yield sr.RegulariserPlugin(name='odd', factory='os:_exit_')",
     "loading 'os:_exit_' raised AttributeError"),
]  # fmt: skip


@pytest.mark.parametrize(("body", "words"), MODULES)
def test_a_plugin_whose_module_or_hook_fails_is_named_with_its_file(body, words, status, tmp_path) -> None:
    code, said = status(HEAD + body, {"regulariser": "odd"})
    flat = " ".join(said.split())
    assert code == 5, said
    assert "'odd' (" in flat
    assert str(tmp_path / "odd.py") in flat
    assert words in flat


def test_a_file_that_does_not_exist_or_an_unknown_name_is_an_error_of_the_input(status, tmp_path) -> None:
    code, said = status(HEAD + "import os\nos.remove(__file__)\nsys.exit(0)", {"plugins": ["gone.py"]})
    assert code == 2
    assert "no such plugin; expected a Python file" in " ".join(said.split())
    code, said = status(plugin("regulariser", "pass"), {"regulariser": "even"})
    assert code == 2
    assert "no regulariser is named 'even'" in said


def test_what_a_component_says_itself_of_its_input_is_not_wrapped(status) -> None:
    code, said = status(plugin("dictionary", "raise sr.InputError('pieces: too few')"), CHOSEN["dictionary"])
    assert code == 2
    assert "pieces: too few" in said


def test_an_object_is_called_by_its_class() -> None:
    class Lost(sr.Maximiser):
        def search(self, objective, rng):
            raise RuntimeError("lost")

    with pytest.raises(sr.PluginError, match=r"maximiser Lost \(.*\): search raised RuntimeError: lost"):
        sr.maximise(lambda points: points[:, 0], sr.Box([0.0], [1.0]), Lost())
