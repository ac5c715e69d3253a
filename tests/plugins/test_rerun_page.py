"""Guards `make live` and ``watch --serve``: the page is there when its address is told, at a port that is free, and one
Ctrl-C ends everything."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest

pytest.importorskip("rerun")

from sparserob_core.experiment.config.load import load_config
from sparserob_rerun.recording import sinks
from tests.support.places import ROOT
from tests.support.recordings import read, scalars, slowness, viewer

PATIENCE = 60.0  # seconds; a loaded machine starts slowly
LATE = 6.0  # seconds into a run at which somebody comes, who stays as long


def variable(name: str) -> str:
    found = re.search(rf"^{name}\s*:= (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert found is not None
    return found.group(1)


def test_make_live_watches_an_annealing_with_keys_that_exist_and_the_literal_one_beside_it() -> None:
    changes = variable("ANNEALING").split()
    for config, overrides, formulation in (("LIVE", changes, "reduced"), ("LITERAL_LIVE", [], "literal")):
        found = load_config(ROOT / variable(config), overrides).config
        assert (found.method.name, found.maximiser.name) == ("sparserob", "simulated_annealing")
        assert found.method.options["formulation"] == formulation
        assert found.dictionaries.control is not None
        assert found.dictionaries.control.options["pieces"] == 100
    assert "live: $(INSTALLED)" in (ROOT / "Makefile").read_text()


def test_the_page_moves_to_another_port_where_its_own_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        monkeypatch.setattr(sinks, "WEB_PORT", taken.getsockname()[1])
        chosen = sinks.look(None, None, False, True)
        assert chosen.web != taken.getsockname()[1]
        assert f"127.0.0.1:{chosen.web}/" in chosen.page
        assert chosen.page.endswith("&hide_welcome_screen=1&theme=dark")  # no welcome, and no white frame
    assert sinks.look(None, None, False, True).web == sinks.WEB_PORT


@pytest.fixture
def watching(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A search that takes minutes, as `make live` watches it on a machine without a display."""
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    command = [
        sys.executable,
        "-m",
        "sparserob_core",
        "watch",
        str(ROOT / variable("LITERAL_LIVE")),
        "--serve",
        "--no-figures",
    ]
    process = subprocess.Popen(
        [*command, "maximiser.budget=100000", "--out", str(tmp_path / "run")],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=tmp_path,
        env=environment,
        start_new_session=True,
    )
    yield process
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    if process.stdout is not None:
        process.stdout.close()


def address(process: subprocess.Popen[str]) -> str:
    """The page that a browser is to open, with what it is told."""
    assert process.stdout is not None
    for line in process.stdout:
        if found := re.search(r"to watch, open (http://127\.0\.0\.1:\d+/\S*)", line):
            return found.group(1)
    raise AssertionError("no address was told")


def answers(page: str) -> bool:
    try:
        with urllib.request.urlopen(page, timeout=5.0) as got:
            return bool(got.status == 200 and b"<html" in got.read().lower())
    except OSError:
        return False


@pytest.mark.slow
def test_the_page_answers_during_the_run_and_one_interrupt_ends_the_run_and_the_page(
    watching: subprocess.Popen[str],
) -> None:
    page, end = address(watching), time.monotonic() + PATIENCE
    while not answers(page):
        assert time.monotonic() < end and watching.poll() is None
        time.sleep(0.2)
    time.sleep(2.0)  # into the search
    assert watching.poll() is None
    os.killpg(watching.pid, signal.SIGINT)
    said, _ = watching.communicate(timeout=PATIENCE)
    assert "interrupted from the keyboard" in said and "Traceback" not in said
    assert watching.returncode in (4, 130)
    end = time.monotonic() + 10.0
    while answers(page):
        assert time.monotonic() < end
        time.sleep(0.2)


@pytest.mark.slow
def test_a_viewer_that_joins_late_has_the_run_from_its_first_evaluation_and_what_comes_after(
    watching: subprocess.Popen[str], tmp_path: Path
) -> None:
    """It takes what the page would take, from the source that the page's address names, and keeps it in a file."""
    page = address(watching)
    (source,) = parse_qs(urlsplit(page).query)["url"]
    late, file = LATE * max(1.0, slowness()), tmp_path / "late.rrd"
    time.sleep(late)
    assert watching.poll() is None
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = str(one.getsockname()[1])
    joining = [str(viewer()), "--bind", "127.0.0.1", "--port", port, "--save", str(file), source]
    process = subprocess.Popen(joining, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(late)
    process.kill()
    process.wait()
    found = read(file)
    seconds, _ = scalars([*found["/search/g/tried"], *found["/search/g/refused"]], "time")
    numbers, _ = scalars([*found["/search/g/tried"], *found["/search/g/refused"]], "evaluation")
    assert numbers[0] == 1 and np.diff(numbers).max() < numbers.size / 10  # no part is missing
    assert seconds[-1] / 1e9 > late  # and it goes on
    assert {"/landscape/map/g", "/physics/plots/curve", "/state", "/verdict", "/log"} <= set(found)
