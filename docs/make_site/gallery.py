"""The gallery: every shipped config with what its run finds and draws. A run is done once for a config and a version of
the program that it runs on, and kept in ``.docs_cache/``."""

from __future__ import annotations

import hashlib
import json
import shutil
from functools import cache
from pathlib import Path

from ruamel.yaml import YAML

import sparserob_core as sr

ROOT = Path(__file__).resolve().parents[2]
CACHE = ROOT / ".docs_cache" / "gallery"
PICTURES = ROOT / "docs" / "generated" / "gallery"
SHOWN = ("states", "control", "clash")
LONG = {"experiment1_paper"}  # minutes: its pictures are in the paper's page


def gallery() -> str:
    """The page."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    lines = [
        "# Every config",
        "",
        "All of `configs/` in the order of their names, with what the run of each finds.",
        "",
    ]
    for config in sorted((ROOT / "configs").glob("*.yaml")):
        lines += _entry(config)
    return "\n".join(lines)


def _entry(config: Path) -> list[str]:
    text = config.read_text(encoding="utf-8")
    title = YAML(typ="safe").load(text).get("title", config.stem)
    lines = [f"## {config.stem}", "", f"{title}. `sparserob run configs/{config.name}`", ""]
    if config.stem in LONG:
        return [*lines, "A search of minutes: see [the paper's experiments](../paper.md).", ""]
    run = _run(config, text)
    result = json.loads((run / "result.json").read_text(encoding="utf-8"))
    lines += [f"**{result['status']}** {result['message'].replace('$', chr(92) + '$').replace('|', chr(92) + '|')}", ""]
    for figure in SHOWN:
        source = run / "figures" / f"{figure}.png"
        if source.exists():
            target = PICTURES / f"{config.stem}-{figure}.png"
            shutil.copyfile(source, target)
            lines += [f"![{figure} of {config.stem}](gallery/{target.name})", ""]
    return lines


@cache
def program() -> bytes:
    """The sources of the program, as one hash."""
    sources = sorted(path for folder in ("sparserob_core", "plugins") for path in (ROOT / folder).rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).digest()


def _run(config: Path, text: str) -> Path:
    run = CACHE / f"{config.stem}-{hashlib.sha256(text.encode() + program()).hexdigest()[:12]}"
    if not (run / "result.json").exists():
        shutil.rmtree(run, ignore_errors=True)
        sr.run(config, out=run, quiet=True)
    return run
