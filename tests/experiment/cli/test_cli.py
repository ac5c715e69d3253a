"""Guards experiment/cli: the command: statuses, messages without tracebacks, tables, and a start that costs nothing."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from tests.support.stub import Command


def test_a_run_prints_a_table_and_where_everything_is(config: Path, process: Command) -> None:
    patient = "observers=[{name: progress, patience: 600}]"  # however slow the machine is, no progress is shown
    done = process("run", config, patient, "--out", "out", "--no-figures")
    assert done.returncode == 0, done.stderr
    for name in (
        "lower bound",
        "upper bound",
        "relative gap",
        "worst violation",
        "active indices",
        "share of time active",
        "switches",
        "seconds",
    ):
        assert name in done.stdout
    assert "written to out" in done.stdout
    assert done.stderr == ""


@pytest.mark.first(3)
@pytest.mark.parametrize(
    ("status", "expected"),
    [("certified", 0), ("verified", 0), ("infeasible", 3), ("refuted", 4), ("undecided", 4), ("failed", 5)],
)
def test_the_exit_status_is_the_status_of_the_result(
    config: Path, command: Command, status: str, expected: int
) -> None:
    done = command("run", config, f"method.status={status}", "--no-figures", "--quiet")
    assert (done.returncode, done.stdout, done.stderr) == (expected, "", "")


def test_json_is_the_file_and_nothing_else(config: Path, command: Command, tmp_path: Path) -> None:
    done = command("run", config, "--json", "--out", "out", "--no-figures")
    assert json.loads(done.stdout) == json.loads((tmp_path / "out" / "result.json").read_text())


@pytest.mark.parametrize(
    "arguments",
    [
        ["run"],
        ["run", "nothing.yaml"],
        ["run", "."],
        ["run", "small.yaml", "method.name=stubb"],
        ["run", "small.yaml", "--uot", "x"],
        ["run", "small.yaml", "--out", "small.yaml"],
        ["run", "small.yaml", "--out", "."],
        ["plugins", "piqpp"],
        ["figures", "."],
        ["walk"],
        ["run", "small.yaml", "problem.horizon=0"],
        ["run", "small.yaml", "problem.control.box=-1"],
        ["run", "small.yaml", "rubbish"],
    ],
)
def test_an_input_at_fault_is_status_2_one_message_and_no_traceback(
    config: Path, command: Command, arguments: list[str]
) -> None:
    done = command(*arguments)
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    assert "rror" in done.stderr
    assert not (config.parent / "runs").exists()


@pytest.mark.parametrize(
    ("arguments", "named", "more"),
    [
        (["runn"], "runn", "sparserob"),
        (["new-plugin", "set"], "NAME", "sparserob new-plugin"),
        (["run", "small.yaml", "--nope"], "--nope", "sparserob run"),
        (["new-plugin", "set", "mine", "--out", "small.yaml"], "small.yaml", "sparserob new-plugin"),
    ],
)
def test_a_command_line_at_fault_is_one_line_in_the_style_of_every_error(
    config: Path, command: Command, arguments: list[str], named: str, more: str
) -> None:
    done = command(*arguments)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert line.removeprefix("error: ")[0].islower()
    assert named in line
    assert line.endswith(f" (`{more} --help` says more)")


@pytest.mark.slow
def test_a_traceback_is_there_for_those_who_ask(config: Path, process: Command) -> None:
    assert "Traceback" in process("run", config, "problem.horizon=0", SPARSEROB_DEBUG="1").stderr


def test_a_fault_of_the_program_is_status_5_and_says_what_was_saved(config: Path, command: Command) -> None:
    done = command("run", config, "method.fail=true", "--out", "out")
    assert done.returncode == 5
    assert "solve raised RuntimeError: the stub fell over" in " ".join(done.stderr.split())
    assert "what was done until then is in out" in done.stderr
    assert "Traceback" not in done.stderr


def test_plugins_are_listed_with_who_brings_them(command: Command) -> None:
    done = command("plugins")
    assert done.returncode == 0
    rows = [line.split()[:3] for line in done.stdout.splitlines()]
    assert ["solver", "piqp", "piqp"] in rows
    assert ["method", "exchange", "core"] in rows


def test_a_component_is_listed_with_its_distribution_and_version_or_its_file(command: Command, tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "import sparserob_core as sr\n\n\nclass Mine(sr.Maximiser, sr.Options):\n"
        "    def search(self, objective, rng):\n"
        "        return float('inf')\n\n\n@sr.hookimpl\ndef sparserob_maximisers():\n"
        "    yield sr.MaximiserPlugin(name='mine', factory=Mine, summary='None.')\n"
    )
    lines = command("plugins", "--plugins", file).stdout.splitlines()
    assert any(line.split()[:5] == ["solver", "piqp", "piqp", "sparserob", version("sparserob")] for line in lines)
    assert any(line.split()[:3] == ["maximiser", "mine", "mine"] and str(file) in line for line in lines)
    assert command("plugins", "--plugins", tmp_path / "none.py").returncode == 2


@pytest.mark.parametrize("name", ["piqp", "solver.piqp"])
def test_a_plugin_is_described_by_its_options(command: Command, name: str) -> None:
    done = command("plugins", name)
    assert done.returncode == 0
    assert "solver piqp" in done.stdout
    assert done.stdout.splitlines()[1].split() == ["option", "type", "default", "range", "meaning"]


def test_a_broken_plugin_is_told_beside_the_list(command: Command) -> None:
    done = command("plugins", SPARSEROB_DISABLE_PLUGINS="piqp")
    assert done.returncode == 0
    assert " piqp " not in done.stdout


@pytest.mark.slow
def test_the_schema_describes_what_is_installed(command: Command) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    done = command("schema")
    schema = json.loads(done.stdout)
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    problem = {
        "name": "linear",
        "system": {"A": [[0]], "B": [[1]]},
        "horizon": 1,
        "initial_state": [1],
        "control": {"box": 1},
    }
    assert validator.is_valid(
        {"problem": problem, "solver": "piqp", "maximiser": {"name": "direct", "budget": 3}, "observers": []}
    )
    assert not validator.is_valid({"problem": problem, "solver": "piq"})
    assert not validator.is_valid({"problem": problem, "sover": "piqp"})
    assert not validator.is_valid({"problem": {**problem, "horizn": 1}})


@pytest.mark.slow
def test_every_config_of_the_repository_fits_the_schema_also_when_resolved(repository: Path, command: Command) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    from sparserob_core.experiment.config.load import load_config

    validator = jsonschema.Draft202012Validator(json.loads(command("schema").stdout))
    configs = sorted((repository / "configs").glob("*.yaml"))
    assert configs
    for config in configs:
        loaded = load_config(config)
        validator.validate(loaded.source.data)
        validator.validate(loaded.config.plain())


@pytest.mark.slow
def test_a_small_run_imports_neither_an_optimiser_nor_the_checker_nor_what_draws(
    repository: Path, tmp_path: Path
) -> None:
    arguments = [str(repository / "configs" / "experiment1_repaired.yaml"), "--no-figures", "--quiet"]
    program = (
        "import sys\nfrom sparserob_core.experiment.cli.main import _run_command_line\n"
        f"assert _run_command_line(['run', *{arguments!r}, '--out', {str(tmp_path / 'run')!r}]) == 0\n"
        "print(*sorted(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "scipy.sparse" in loaded
    assert not loaded & {"scipy.optimize", "piqp", "sparserob_core.checker", "matplotlib", "rich", "flint"}
    elsewhere = (
        "control.feedback.closed_loop",
        "control.reach.measurable",
        "sip.working.robust",
        "sip.search.search",
    )
    assert not loaded & {f"sparserob_core.{module}" for module in elsewhere}


@pytest.mark.slow
def test_the_check_of_a_small_run_imports_neither_sparse_matrices_nor_what_transcribes(
    repository: Path, tmp_path: Path, command: Command
) -> None:
    directory = str(tmp_path / "run")
    command("run", repository / "configs" / "double_integrator.yaml", "--no-figures", "--quiet", "--out", directory)
    program = (
        "import sys\nfrom sparserob_core.experiment.cli.main import _run_command_line\n"
        f"assert _run_command_line(['check', {directory!r}]) == 0\nprint(*sorted(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert {"flint", "sparserob_core.checker.claims.claims"} <= loaded
    assert not loaded & {
        "scipy.sparse",
        "sparserob_core.control.transcription",
    }


@pytest.mark.slow
def test_a_reader_that_stops_reading_is_no_error(tmp_path: Path) -> None:
    done = subprocess.run(
        f"{sys.executable} -m sparserob_core plugins | head -n 1; exit ${{PIPESTATUS[0]}}",
        shell=True,
        executable="/bin/bash",
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
