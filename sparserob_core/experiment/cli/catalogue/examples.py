"""``sparserob examples``: the experiments that come with the distribution, to be read, copied and run."""

from __future__ import annotations

from pathlib import Path

import click

from sparserob_core.experiment.terminal.printing import say


@click.command()
@click.argument("name", required=False)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=".",
    show_default="the current folder",
    help="Folder into which the config is copied.",
)
def examples(name: str | None, out: Path) -> int:
    """List the experiments that come with the distribution, or copy the config of one, NAME. Nothing is overwritten."""
    from sparserob_core.errors import InputError
    from sparserob_core.experiment.config.examples import example
    from sparserob_core.experiment.config.examples import examples as every
    from sparserob_core.experiment.terminal.table import print_table

    if name is None:
        rows = [(entry.name, entry.title, entry.story) for entry in every()]
        print_table("Examples; sparserob examples NAME copies one", ("name", "title", "what it is about"), rows)
        return 0
    chosen, file = example(name), out / f"{name}.yaml"
    try:
        out.mkdir(parents=True, exist_ok=True)
        with file.open("x", encoding="utf-8") as opened:
            opened.write(chosen.text)
    except FileExistsError:
        raise InputError(f"{file}: expected no file of that name, which would be overwritten") from None
    except OSError as error:
        raise InputError(f"{file}: cannot be written: {error.strerror}") from None
    say(f"written to {file}; next: sparserob run {file}")
    return 0
