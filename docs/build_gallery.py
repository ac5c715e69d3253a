"""The pictures of docs/gallery.md: every story is run as a user runs it, and its figures are copied."""

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
    "motor_voltage": ("states",),
    "experiment1_feedback": ("states", "gains", "effort", "answers"),
    "output_feedback": ("outputs",),
    "singular": ("control",),
}
"""The configs of the page, and which of their figures it shows."""


def main() -> int:
    """Make every picture anew; returns the exit status."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        for name, figures in STORIES.items():
            click.echo(name)
            run = ["run", f"configs/{name}.yaml", "--out", f"{place}/{name}"]
            done = subprocess.run(
                [sys.executable, "-m", "sparserob_core", *run], cwd=ROOT, capture_output=True, text=True, check=False
            )
            if done.returncode:
                click.echo(done.stdout + done.stderr, err=True)
                return 1
            for figure in figures:
                shutil.copyfile(Path(place) / name / "figures" / f"{figure}.png", PICTURES / f"{name}_{figure}.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
