"""Guards `make test-pythons`: an interpreter is found where people have it, and one that is not there is named."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.support.places import ROOT

STAND_IN = """#!/bin/sh
# Makes environments of itself, and writes down what it was asked for.
echo "$@" >> "$ASKED"
if [ "$2" = venv ]; then mkdir -p "$4/bin" && cp "$0" "$4/bin/python"; fi
"""


@pytest.mark.skipif(os.name != "posix" or shutil.which("make") is None, reason="make is asked")
def test_interpreters_of_pyenv_are_found_though_their_names_on_the_path_do_not_answer(tmp_path: Path) -> None:
    for place, text in (("versions/3.77.1/bin/python", STAND_IN), ("shims/python3.77", "#!/bin/sh\nexit 127\n")):
        file = tmp_path / place
        file.parent.mkdir(parents=True)
        file.write_text(text)
        file.chmod(0o755)
    asked, environment = tmp_path / "asked", tmp_path / "environment"
    done = subprocess.run(
        ["make", "-s", "test-pythons", "PYTHONS=python3.77 python3.78", f"VENV={environment}"],
        cwd=ROOT,
        env={
            "PATH": f"{tmp_path / 'shims'}{os.pathsep}{os.environ['PATH']}",
            "PYENV_ROOT": str(tmp_path),
            "ASKED": str(asked),
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines() == ["python3.78: not found, left out"]
    commands = asked.read_text().splitlines()
    assert f"-m venv --clear {environment}/pythons/python3.77" in commands
    assert commands[-1].startswith("-m pytest")
