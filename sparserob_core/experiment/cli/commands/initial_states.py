"""``sparserob initial-states``: from which initial states an experiment is feasible, and at what cost."""

from __future__ import annotations

from pathlib import Path

import click

from sparserob_core.errors import InputError
from sparserob_core.experiment.cli.shell.options import json_option, out_option
from sparserob_core.experiment.cli.shell.process import status_unless_interrupted
from sparserob_core.experiment.cli.shell.report import report
from sparserob_core.experiment.terminal.printing import EXIT


@click.command("initial-states")
@click.argument("config", type=click.Path(path_type=Path))
@click.argument("overrides", nargs=-1, metavar="[KEY=VALUE]...")
@click.option(
    "--states",
    default="1,2",
    show_default=True,
    metavar="I,J",
    help="The two states whose initial values are free, from 1.",
)
@click.option(
    "--directions", type=int, default=32, show_default=True, help="Support functions asked for at most, at least 4."
)
@click.option(
    "--values",
    type=int,
    default=15,
    show_default=True,
    help="Costs are measured on a lattice of so many points each way; 0: none.",
)
@click.option(
    "--about",
    metavar="X,...",
    help="The initial state whose other coordinates the plane has; the config's unless given.",
)
@click.option(
    "--within",
    type=float,
    help="Only initial values of at most this size are looked at; needed where the set is unbounded.",
)
@json_option("initial_states.json")
@out_option("A new or empty directory for the config, initial_states.json, initial_states.npz and initial_states.png.")
def initial_states(
    config: Path,
    overrides: tuple[str, ...],
    states: str,
    directions: int,
    values: int,
    about: str | None,
    within: float | None,
    as_json: bool,
    out: Path | None,
) -> int:
    """Find the initial states from which the experiment that CONFIG describes is feasible.

    They make a convex set. The command prints an inner polygon, every point of which is proven feasible, and an outer
    one, outside of which every point is proven infeasible, and draws both with the cost as colour. With policy: affine,
    infeasible says that there is no affine policy. KEY=VALUE changes the config.

    Exit status: 0 the set is known from both sides, 2 the input is at fault, 3 it is empty, proven, 4 no point is
    proven, 130 interrupted.
    """
    from sparserob_core.experiment.cli.shell.live_line import LiveLine
    from sparserob_core.experiment.initial_states.initial_states import initial_states as find

    chosen = [int(number) - 1 for number in _parse_numbers("states", states)]
    try:
        with LiveLine() as line:
            feasible_set = find(
                config,
                overrides,
                chosen,
                directions=directions,
                values=values,
                about=None if about is None else _parse_numbers("about", about),
                within=within,
                out=out,
                notify=line.receive,
            )
    except InputError as error:
        if error.path != ("states",):
            raise
        raise InputError(path="--states", expected="two different states, counted from 1", got=repr(states)) from None
    remarks = (*feasible_set.remarks, *([f"written to {out}"] if out is not None else []))
    report(as_json, feasible_set.summary(), [(feasible_set.title, (), feasible_set.rows())], remarks)
    return status_unless_interrupted(EXIT[feasible_set.status])


def _parse_numbers(name: str, text: str) -> list[float]:
    try:
        numbers = [float(token) for token in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or (name == "states" and any(not number.is_integer() or number < 1 for number in numbers)):
        expected = "two different states, counted from 1, such as 1,2" if name == "states" else "numbers, such as 0,0.5"
        raise InputError(f"--{name}: expected {expected}, got {text!r}")
    return numbers
