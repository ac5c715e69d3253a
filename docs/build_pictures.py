"""``make docs-pictures``: the pictures of docs/live.md, from runs and a study as a user has them, tens of seconds each.

Needs the extra ``rerun`` and a Vulkan driver, which a machine without a graphics card has in software (Debian and
Ubuntu: ``apt install mesa-vulkan-drivers``); no display. The viewer is started without a window, and told what to show.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click

ROOT = Path(__file__).resolve().parent.parent
PICTURES = ROOT / "docs" / "figures" / "live"
SIZE = "1600x1000"
BLANK = 40_000  # bytes: a picture that is smaller shows an empty window
STARTING, LOADING, DRAWING = 30.0, 9.0, 4.0  # seconds
TRIES = 5  # of a picture, for each of which the viewer has a quarter of a minute

EXCHANGE = ["watch", "configs/experiment1_repaired.yaml"]
SEARCH = [  # what `make live` shows
    *("watch", "configs/experiment1_reduced.yaml", "maximiser.name=simulated_annealing", "maximiser.budget=1500"),
    *("maximiser.cooling_range=1e-3", "maximiser.polish=0.2", "method.sc2=null", "method.indices=20"),
    "continuation.stop=1e-6",
]
FEEDBACK = ["watch", "configs/experiment1_feedback.yaml"]
INFEASIBLE = ["watch", "configs/experiment2_repaired.yaml", "problem.path.0.from=1.0"]
STUDY = ["sweep", "configs/double_integrator.yaml", "problem.horizon=3:6:7", "problem.control.box=0.6:1.6:6"]
RENDEZVOUS = ["watch", "configs/atv_box.yaml"]
SIDE_BY_SIDE = [
    *("sweep", "configs/experiment1_reduced.yaml", "maximiser.name=simulated_annealing,lipo"),
    *("maximiser.budget=200", "continuation.stop=1e-2"),
]
MARGIN = ["margin", "configs/experiment1_repaired.yaml", "--curve", "10"]
RUNS: dict[str, tuple[list[str], dict[str, str]]] = {
    "exchange": (EXCHANGE, {"Overview": "exchange", "Exchange": "exchange_tab"}),
    "search": (SEARCH, {"Overview": "search", "Search": "search_tab", "Landscape as a surface": "surface"}),
    "feedback": (FEEDBACK, {"Feedback": "feedback"}),
    "infeasible": (INFEASIBLE, {"Overview": "infeasible"}),
    "rendezvous": (RENDEZVOUS, {"Overview": "rendezvous"}),
    "study": (STUDY, {"Study": "study"}),
    "side_by_side": (SIDE_BY_SIDE, {"Runs side by side": "side_by_side"}),
    "margin": (MARGIN, {"Study": "margin"}),
}
"""What is run, and which of its tabs become which pictures."""


def main() -> int:
    """Make every picture anew; returns the exit status."""
    if find_spec("rerun") is None or find_spec("rerun_cli") is None:
        click.echo("rerun-sdk is not installed; `pip install rerun-sdk` brings it", err=True)
        return 2
    with tempfile.TemporaryDirectory() as place:
        for name, (arguments, tabs) in RUNS.items():
            file = Path(place) / f"{name}.rrd"
            click.echo(f"{name}: sparserob {' '.join(arguments)}")
            began = time.monotonic()
            command = [sys.executable, "-m", "sparserob_core", *arguments, "--save", str(file)]
            command += ["--out", f"{place}/{name}", *(["--no-figures"] if arguments[0] != "margin" else [])]
            done = subprocess.run(command, cwd=ROOT, capture_output=True, check=False)  # its status is its verdict
            if not file.is_file():
                click.echo(done.stderr.decode(errors="replace"), err=True)
                return 1
            click.echo(f"  {time.monotonic() - began:.0f} s; its pictures")
            with viewer() as client:
                client.open(str(file))
                time.sleep(LOADING)
                for tab, picture in tabs.items():
                    if not taken(client, tab, PICTURES / f"{picture}.png"):
                        return 1
    return 0


def taken(client: Any, tab: str, file: Path) -> bool:
    """Bring a tab to the front and write its picture; whether there is one."""
    shown = arrangement(client)
    root = next(
        key for key, value in shown.items() if value.get("ContainerBlueprint", {}).get("container_kind") == "Tabs"
    )
    container = shown[root]["ContainerBlueprint"]
    places = container["contents"] if isinstance(container["contents"], list) else [container["contents"]]
    names = {name_of(shown["/" + place.lstrip("/")]): place for place in places}
    if tab not in names:
        click.echo(f"there is no tab {tab!r}; there are {', '.join(names)}", err=True)
        return False
    container["active_tab"] = names[tab]
    client.set_blueprint(shown, of="recording")
    time.sleep(DRAWING)
    for view in client.get_state().views:
        if view.reports:
            click.echo(f"the viewer complains of {view.name}: {view.reports}", err=True)
            return False
    for _ in range(TRIES):
        try:
            client.save_screenshot(str(file))
            break
        except TimeoutError:  # a machine that has much else to do
            time.sleep(DRAWING)
    if not file.is_file() or file.stat().st_size < BLANK:
        click.echo(f"{file}: the viewer has drawn nothing; is there a Vulkan driver (mesa-vulkan-drivers)?", err=True)
        return False
    click.echo(f"  {file.relative_to(ROOT)}")
    return True


def arrangement(client: Any) -> dict[str, Any]:
    """The blueprint of what is shown, as plain data."""
    found = client.get_blueprint()
    return json.loads(json.dumps(found if isinstance(found, dict) else found.blueprint))


def name_of(part: dict[str, Any]) -> str:
    """What a view or a container is called."""
    return str((part.get("ContainerBlueprint") or part.get("ViewBlueprint") or {}).get("display_name", ""))


@contextmanager
def viewer() -> Iterator[Any]:
    """A viewer without a window, and a client that tells it what to do."""
    import rerun_cli
    from rerun.experimental import ViewerClient

    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    # the program itself: the script `rerun` would leave it behind
    command = [str(Path(rerun_cli.__file__).parent / "rerun"), "--headless", "--bind", "127.0.0.1", "--port", str(port)]
    process = subprocess.Popen(
        [*command, "--hide-welcome-screen", "--window-size", SIZE], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        end = time.monotonic() + STARTING
        while True:
            try:
                client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
                break
            except Exception as error:  # noqa: BLE001  whatever says that it does not listen yet
                if time.monotonic() > end or process.poll() is not None:
                    raise SystemExit(f"the viewer does not start; a Vulkan driver is needed: {error}") from None
                time.sleep(0.2)
        yield client
    finally:
        process.kill()
        process.wait()


if __name__ == "__main__":
    sys.exit(main())
