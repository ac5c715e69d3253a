"""Writes docs/reference.md, configs/schema.json and the table of pairs in docs/scope.md from what the program says of
itself: ``make docs``."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Iterator
from pathlib import Path

import click

import sparserob_core as sr
from sparserob_core.control.combinations import FEATURES, refused_pairs
from sparserob_core.experiment.cli.main import commands
from sparserob_core.experiment.config.extending import EXTENDS
from sparserob_core.experiment.config.extending import MEANING as MEANS
from sparserob_core.experiment.config.option_rows import option_rows
from sparserob_core.experiment.config.run_config import RunConfig
from sparserob_core.experiment.config.schema import config_schema
from sparserob_core.experiment.plugins.commands import COMMANDS
from sparserob_core.experiment.plugins.hookspecs import HOOKS
from sparserob_core.experiment.terminal.printing import EXIT
from sparserob_core.options import meanings

ROOT = Path(__file__).resolve().parents[1]
PAIRS_BEGIN, PAIRS_END = "<!-- pairs: by docs/build_reference.py -->", "<!-- end of pairs -->"
REASONS = ["For every pair that is refused, the error says what is expected instead:"]
MEANING = {
    0: "certified or verified",
    2: "the input is at fault",
    3: "infeasible",
    4: "refuted or undecided",
    5: "failed, or a component of a plugin failed",
    130: "interrupted",
}
FILES = {
    "config.yaml": "the complete, resolved config; `sparserob run` takes it",
    "result.json": (
        "status, message, cost, value, epsilon, bounds, gap, worst constraint, equalities (by how much fixed"
        " final states are `missed` at most, and how much is `excused`), tolerances (what is proven of each constraint:"
        " `kept` and, as `rows`, excused, of every row in the user's units), sparsity (with"
        " `fewest_active`: `lower` and `upper` of the least share of time that any admissible control"
        " must act, the mean over the `channels`); `units` (of time, states, cost, J, and of the rows of every"
        " constraint,"
        " where the config names any); `parameters` (the names of what is uncertain, in order);"
        " under feedback `causal_lower_bound` (no causal policy with this dictionary costs less; null where"
        " nothing is proven), `causal_infeasible` (no causal policy exists) and `causal_ended` (why no better bound"
        " was sought: `settled`, as the last rounds did not improve it, or the limit that was met: `signals`, `work`,"
        " or the brake of `seconds`, whose number depends on the machine), counts"
        " (`solved_by`: who answered how many relaxed programs; `solver_calls`), notes (what had nothing to do though"
        " the config names it, and programs that a named solver left to another: `key`, `place`, `note`),"
        " seconds (of the method: solving and proving, neither reading nor drawing),"
        " seed, versions; for the scenario approach"
        " `scenario_bound`; `upper_bound` and `gap` are null unless the status is certified or verified; `provenance`:"
        " the hash of what decides the result, when the run started, the git revision of the config's folder, host,"
        " contents of the plugin files"
    ),
    "certificate.json": (
        "what is claimed and what proves it; `sparserob check` takes it, [certificate.md](certificate.md) explains it"
    ),
    "solution.npz": (
        "`breakpoints (K+1,)`, `control (m, K)`, `theta (m, N)`; of the imposed constraints `times`, `indices`, `rows`,"
        " `families`, `formulations`, `multipliers`; the same of the constraints that prove the lower bound, as"
        " `bound_indices`, ..., under feedback each at its deviation; and `bound_equalities`"
    ),
    "evaluations.npz": (
        "for a method that searches, one entry per value of g: outer iteration, epsilon, value, proven lower bound,"
        " seconds, `points (n, d)` unless they are too many, and `note_...` for what the maximiser noted"
    ),
    "trace.npz": "one array per column, one entry per round: bounds, violation, epsilon, indices, seconds",
    "rounds.npz": (
        "the decision of every round and the constraints that it imposed, with their multipliers, unless they are too"
        " many"
    ),
    "adversary.npz": "per constraint its worst time, parameter, disturbance and the states that these cause",
    "simulation-LAW.json": "written by `sparserob simulate`: how often trajectories under a law break each constraint",
    "figures/": "`control`, `switching` (why it acts), `states`, `plane` (where `names.plane` says one), `convergence`,"
    " `adversary`, each as PDF"
    " and PNG; `clash` when infeasible; of a"
    " search `climb` and `landscape`; an extra: where they cannot be drawn a line says so, and the status of the run"
    " stays as it is",
}

STUDY = {
    "sweep.yaml": "the base config and the axes: `sparserob sweep sweep.yaml --out ELSEWHERE` does the study again",
    "runs/": "one run directory for every point, named by its values and the first letters of its hash",
    "table.csv": (
        "one row for every point: the axes, then the numbers and texts of its `result.json`, an entry of an object as"
        " `object.entry`; numbers can be read back exactly, what is not known is empty; `seconds` is the last column"
    ),
    "columns.csv": "the unit and the meaning of every column of `table.csv`",
    "sweep.pdf, sweep.png": (
        "curves of cost and lower bound along one numeric axis, a map of the cost over two, otherwise costs and seconds"
        " side by side; every status has its mark, seeds are a median with quartiles"
    ),
}


def reference() -> str:
    """The whole page."""
    head = ["# Reference", "", "Written by `make docs` from what the program says of itself; the tests compare."]
    parts = [head, _commands(), _config(), _components(), _hooks(), _files(), _names()]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def schema() -> str:
    """The JSON schema of a config."""
    return json.dumps(config_schema(sr.load_registry()), indent=2) + "\n"


def table(columns: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    """A Markdown table."""
    lines = [columns, tuple("---" for _ in columns), *rows]
    return ["| " + " | ".join(" ".join(cell.replace("|", "\\|").split()) for cell in line) + " |" for line in lines]


def _commands() -> list[str]:
    lines = ["## Commands", ""]
    for name in COMMANDS:
        command = commands.get_command(click.Context(commands), name)
        context = click.Context(command, info_name=f"sparserob {name}")
        usage = [
            parameter.make_metavar(context) for parameter in command.params if isinstance(parameter, click.Argument)
        ]
        lines += [
            f"### `sparserob {name}`",
            "",
            f"`{' '.join(['sparserob', name, *usage])}`",
            "",
            inspect.cleandoc(command.help or ""),
            "",
        ]
        options = [
            (f"`{'`, `'.join([*option.opts, *option.secondary_opts])}`", option.help or "")
            for option in command.params
            if isinstance(option, click.Option)
        ]
        lines += [*table(("option", "meaning"), options), ""] if options else []
    ends = sorted({*EXIT.values(), *MEANING})
    return [*lines, "### Exit status", "", *table(("status", "meaning"), [(str(end), MEANING[end]) for end in ends])]


def _config() -> list[str]:
    rows, defaults = [], RunConfig.model_construct(problem=None).model_dump(mode="json")
    for name, field in RunConfig.model_fields.items():
        default = "required" if field.is_required() else f"`{json.dumps(defaults[name])}`"
        rows.append((f"`{name}`", default, meanings(RunConfig)[name]))
    rows.insert(0, (f"`{EXTENDS}`", "none", MEANS))
    return [
        "## Keys of a config",
        "",
        *table(("key", "default", "meaning"), rows),
        "",
        (
            "A component is written as a mapping with its `name` and its options, or as its bare name. `maximiser` also"
            " takes `budget`. Instead of `problem`, a config may name another one that it `extends`."
        ),
    ]


def _components() -> list[str]:
    lines = ["## Components"]
    for record in sr.load_registry().records():
        if record.usage:  # commands have a section
            continue
        rows = [
            (f"`{row.name}`", row.type, row.default and f"`{row.default}`", row.range, row.meaning)
            for row in option_rows(record, ask=False)
        ]
        lines += ["", f"### {record.kind} `{record.name}`", "", record.summary, ""]
        own = f"`sparserob plugins {record.name}` lists the settings of the installed package."
        lines += table(("option", "type", "default", "range", "meaning"), rows) if rows else []
        lines += [own] if record.open else [] if rows else ["It has no options."]
    return lines


def _hooks() -> list[str]:
    hooks = [(f"`{name}`", inspect.getdoc(HOOKS[name]) or "") for name in sorted(HOOKS)]
    return [
        "## Hooks",
        "",
        "[extending.md](extending.md) shows how to implement them.",
        "",
        *table(("hook", "a component is"), hooks),
    ]


def _files() -> list[str]:
    return [
        "## Files of a run",
        "",
        *table(("file", "contents"), [(f"`{name}`", text) for name, text in FILES.items()]),
        "",
        "## Files of a study",
        "",
        *table(("file", "contents"), [(f"`{name}`", text) for name, text in STUDY.items()]),
    ]


def _names() -> list[str]:
    rows = [(f"`{name}`", _first_sentence(getattr(sr, name))) for name in sr.__all__]
    return ["## Names of `sparserob_core`", "", *table(("name", "what it is"), rows)]


def _first_sentence(thing: object) -> str:
    if not (inspect.isclass(thing) or inspect.isfunction(thing)):
        return "A type: an array of doubles."
    return (inspect.getdoc(thing) or "").split("\n\n")[0]


def pairs() -> str:
    """Return the page docs/scope.md with the table of pairs, and the reason of every pair that is refused."""
    page = (ROOT / "docs" / "scope.md").read_text(encoding="utf-8")
    before, rest = page.split(PAIRS_BEGIN)
    after = rest.split(PAIRS_END)[1]
    refused = {frozenset(pair) for *pair, _ in refused_pairs()}
    signs = [["–" if {row, column} in refused else "●" for column in FEATURES] for row in FEATURES]
    rows = [(f"{k}. {name}", *line) for k, (name, line) in enumerate(zip(FEATURES, signs, strict=True), 1)]
    lines = table(("", *(str(k) for k in range(1, len(FEATURES) + 1))), rows)
    numbers: dict[tuple[str, str], list[str]] = {}
    for feature, companion, sentence in refused_pairs():
        numbers.setdefault((feature, sentence), []).append(str(FEATURES.index(companion) + 1))
    reasons = [
        f"* {FEATURES.index(feature) + 1} with {', '.join(columns)}: {re.sub('{.*?}', '…', sentence)}."
        for (feature, sentence), columns in numbers.items()
    ]
    return "\n".join([before + PAIRS_BEGIN, "", *lines, "", *REASONS, "", *reasons, "", PAIRS_END + after])


def pages() -> Iterator[tuple[Path, str]]:
    """Every generated file with its text."""
    yield ROOT / "docs" / "reference.md", reference()
    yield ROOT / "configs" / "schema.json", schema()
    yield ROOT / "docs" / "scope.md", pairs()


if __name__ == "__main__":
    for path, text in pages():
        path.write_text(text, encoding="utf-8")
