"""The configs of this distribution: complete experiments, each with a story."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import final

from sparserob_core.errors import InputError

SCHEMA = "# yaml-language-server:"  # a line for editors, of use only in the folder with the schema's file


@final
@dataclass(frozen=True)
class Example:
    """A config of this distribution.

    Parameters
    ----------
    name : str
        Its name.
    title : str
        The title of its runs.
    story : str
        The comment at its beginning.
    text : str
        Its complete text. That of a config which extends another one has the keys of both.
    """

    name: str
    title: str
    story: str
    text: str


def shipped(name: str) -> Path:
    """Return the file of a config of this distribution; it need not exist."""
    return _find_folder() / f"{name}.yaml"


def examples() -> list[Example]:
    """Return all configs of this distribution, by name."""
    return [_read_example(file) for file in sorted(_find_folder().glob("*.yaml"))]


def example(name: str) -> Example:
    """Return the config of that name; raises `InputError` where there is none."""
    from sparserob_core.experiment.plugins.messages import nearest

    names = [file.stem for file in _find_folder().glob("*.yaml")]
    if name not in names:
        raise InputError(f"examples: there is none called {name!r}{nearest(name, set(names))}")
    return _read_example(shipped(name))


def _find_folder() -> Path:
    """Return the folder of the configs: next to the package in a repository, within it where it is installed."""
    package = Path(__file__).resolve().parents[2]
    folders = [folder / "configs" for folder in (package, package.parent)]
    return next((folder for folder in folders if folder.is_dir()), folders[-1])


def _read_example(file: Path) -> Example:
    text = _complete_text(file)
    lines = [line for line in text.splitlines() if not line.startswith(SCHEMA)]
    story = " ".join(line.lstrip("# ") for line in _take_leading_comments(lines))
    title = re.search(r"^title: *(.*?) *$", text, re.MULTILINE)
    return Example(file.stem, file.stem if title is None else title[1].strip("'\""), story, "\n".join(lines) + "\n")


def _complete_text(file: Path) -> str:
    """Return the complete text of a config.

    A config that extends another one gets the keys that it lacks, as they are written there. Where that text would have
    another meaning, the result is plain data.
    """
    from sparserob_core.experiment.config.extending import EXTENDS, extended
    from sparserob_core.experiment.config.reading.reader import read_source, read_value, write_yaml

    text = file.read_text("utf-8")
    if f"\n{EXTENDS}:" not in text:
        return text
    source = read_source(file)
    data = extended(source).data
    own, base = _split_keys(text), _split_keys(_complete_text(source.folder / source.data[EXTENDS]))
    del own[EXTENDS]
    story = "".join(f"{line}\n" for line in _take_leading_comments(text.splitlines()))
    composed = story + "".join({**base, **own}.values())
    return composed if read_value(composed) == data else story + write_yaml(data)


def _split_keys(text: str) -> dict[str, str]:
    """Return the lines of every key at the top of a config."""
    sections = re.split(r"^(?=[a-z_]+:)", text, flags=re.MULTILINE)[1:]
    return {section.partition(":")[0]: section if section.endswith("\n") else f"{section}\n" for section in sections}


def _take_leading_comments(lines: list[str]) -> Iterator[str]:
    for line in lines:
        if not line.startswith("#"):
            return
        yield line
