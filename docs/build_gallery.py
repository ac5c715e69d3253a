"""The pictures of docs/gallery.md and docs/rendezvous.md: every story is run as a user runs it, and its figures are
copied."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import click

ROOT = Path(__file__).resolve().parent.parent
PICTURES = ROOT / "docs" / "figures" / "gallery"
STORIES: dict[str, tuple[str, ...]] = {
    "rendezvous": ("plane", "states"),
    "powered_descent": ("plane", "states"),
    "cart_pendulum": ("states",),
    "tank_levels": ("states",),
    "heated_house": ("states",),
    "tank_farm": ("states",),
    "narrowing_corridor": ("states",),
    "two_modes": ("states",),
    "tracking_corridor": ("states",),
    "ion_trap": ("states", "switching"),
    "motor_voltage": ("states",),
    "experiment1_feedback": ("states", "gains", "effort", "answers"),
    "output_feedback": ("outputs",),
    "singular": ("control",),
    "atv_transfer": ("plane", "switching"),
    "atv_box": ("plane",),
    "simbol_x_box": ("plane",),
}
"""The configs of the pages, and which of their figures they show."""
STUDIES: dict[str, tuple[list[str], str]] = {
    "atv_box_margin": (["margin", "configs/atv_box.yaml", "--of", "initial_state", "--curve", "6"], "margin.png"),
    "atv_flight": (
        ["sweep", "configs/atv_transfer.yaml", "problem.horizon=4000:12000:9", "dictionaries.control.pieces=60"],
        "sweep.png",
    ),
}
"""What is run beside them, and which of its figures becomes the picture of this name."""


def main() -> int:
    """Make every picture anew; returns the exit status."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        for name, figures in STORIES.items():
            if not made(["run", f"configs/{name}.yaml"], f"{place}/{name}"):
                return 1
            for figure in figures:
                shutil.copyfile(Path(place) / name / "figures" / f"{figure}.png", PICTURES / f"{name}_{figure}.png")
        for name, (command, figure) in STUDIES.items():
            if not made(command, f"{place}/{name}"):
                return 1
            shutil.copyfile(Path(place) / name / figure, PICTURES / f"{name}.png")
    return 0


def made(command: list[str], out: str) -> bool:
    """Run a command of ``sparserob`` into a directory; whether that worked."""
    click.echo(" ".join(command))
    done = subprocess.run(
        [sys.executable, "-m", "sparserob_core", *command, "--out", out],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        click.echo(done.stdout + done.stderr, err=True)
    return not done.returncode


if __name__ == "__main__":
    sys.exit(main())
