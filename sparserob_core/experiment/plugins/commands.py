"""The commands of the core: where each one is, its line in ``sparserob --help``, and what any command may return.

They are found here without any import, so that a command starts at once. `builtin` registers the same table.
"""

from __future__ import annotations

_COMMANDS = "sparserob_core.experiment.cli.commands"
_CATALOGUE = "sparserob_core.experiment.cli.catalogue"
COMMANDS: dict[str, tuple[str, str]] = {
    "run": (f"{_COMMANDS}.run:run", "Solve the experiment of a config, and prove the answer."),
    "sweep": (f"{_COMMANDS}.sweep:sweep", "Run a config at every point of some axes, and make one table of it."),
    "watch": (f"{_COMMANDS}.watch:watch", "Run a config, and watch it in the viewer of Rerun."),
    "replay": (f"{_COMMANDS}.replay:replay", "Show a finished run in the viewer of Rerun."),
    "check": (f"{_COMMANDS}.check:check", "Verify a finished run: every claim of its certificate, derived anew."),
    "simulate": (
        f"{_COMMANDS}.simulate:simulate",
        "Propagate random trajectories of a run, and count violations.",
    ),
    "loop": (
        f"{_COMMANDS}.loop:loop",
        "Close the loop around the exact system, and solve at every breakpoint.",
    ),
    "margin": (
        f"{_COMMANDS}.margin:margin",
        "Find how far something can be changed until nothing is feasible.",
    ),
    "bound": (f"{_COMMANDS}.bound:bound", "Bound the worst case of each row over everything that is uncertain."),
    "initial-states": (
        f"{_COMMANDS}.initial_states:initial_states",
        "Find the initial states from which an experiment is feasible.",
    ),
    "compare": (f"{_COMMANDS}.compare:compare", "Compare runs of one problem, or the contenders of studies."),
    "benchmark": (f"{_COMMANDS}.compare:benchmark", "Compare maximisers where the maximum is known."),
    "figures": (f"{_COMMANDS}.figures:figures", "Draw the figures of a finished run again."),
    "plugins": (f"{_CATALOGUE}.plugins:plugins", "List the components that a config can name, or the options of one."),
    "new-plugin": (f"{_CATALOGUE}.plugins:new_plugin", "Write the package of a new plugin, with its tests."),
    "examples": (f"{_CATALOGUE}.examples:examples", "List the experiments that come with SparseRob, or copy one."),
    "schema": (f"{_CATALOGUE}.schema:schema", "Print the JSON schema of a config."),
}

MAX_STATUS = 255  # of a process


def is_status(value: object) -> bool:
    """Return whether a command may return a value: an exit status, or nothing."""
    return value is None or (type(value) is int and 0 <= value <= MAX_STATUS)
