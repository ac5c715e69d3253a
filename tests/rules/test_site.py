"""Guards docs/make_site: every component has its page, docstrings come out as the mathematics that they are, every page
is in the site, and (slow) the site builds without a warning."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.util import find_spec

import pytest
from ruamel.yaml import YAML

import sparserob_core as sr
from tests.support.places import ROOT

sys.path.insert(0, str(ROOT / "docs"))


def test_when_to_use_it_is_told_of_every_component_and_of_no_other():
    when = YAML(typ="safe").load((ROOT / "docs" / "make_site" / "when.yaml").read_text())
    of_plugins = when.pop("plugin")
    records = [record for record in sr.load_registry().records() if not record.usage]  # all but commands
    told = {(kind, name) for kind, names in when.items() for name in names}
    assert told <= {(record.kind, record.name) for record in records}
    untold = [record for record in records if (record.kind, record.name) not in told]
    assert {record.plugin for record in untold} == set(of_plugins)


def test_every_public_name_is_on_one_page_of_the_site():
    from make_site.generated import groups

    names = [name for _, group in groups() for name in group]
    assert sorted(names) == sorted(sr.__all__)


def test_the_options_of_a_component_say_what_may_be_given_and_what_holds_otherwise():
    from make_site.generated import components

    pages = dict(components())
    rows = pages["components/problem/linear.md"].splitlines()
    assert "| option | value | meaning |" in rows
    assert any(row.startswith("| `horizon` | number, > 0.0, required | ") for row in rows)
    assert any(row.startswith("| `cost.l1` | number, >= 0.0, 1.0 unless given | ") for row in rows)
    assert pages["components/dictionary/index.md"].startswith("# Dictionaries\n")


@pytest.mark.parametrize(
    "plain, safe",
    [
        ("``|u|`` and |u|, x* and `Box`", r"``|u|`` and \|u\|, x\* and `Box`"),
        ("two\nlines", "two lines"),
        ("as follows::", "as follows:"),
        ("``a``  one\n``b``  two", "| ``a``  one\n| ``b``  two"),
    ],
)
def test_docstrings_are_escaped_where_they_are_no_markup(plain, safe):
    from make_site import docstrings

    assert docstrings.safe(plain) == safe


def test_every_page_is_in_the_site():
    entries = re.compile(r"^\w[\w/]*$", re.MULTILINE)
    listed = set(entries.findall((ROOT / "docs" / "index.md").read_text()))
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")} - {"index"}
    notebooks = {f"notebooks/{path.stem}" for path in (ROOT / "docs" / "notebooks").glob("*.md")}
    assert pages | notebooks <= listed
    here = {entry for entry in listed if not entry.startswith("generated/") and (ROOT / "docs" / entry).suffix == ""}
    assert not [entry for entry in here if not (ROOT / "docs" / f"{entry}.md").exists()]


@pytest.mark.skipif(find_spec("latex2mathml") is None, reason="the extra docs is not installed")
def test_every_formula_of_a_page_is_set_without_a_script():
    from make_site.mathematics import mathml

    formulas = []
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("**/*.md")]:
        text = re.sub(r"```.*?```|`[^`]*`", "", page.read_text(), flags=re.DOTALL)
        formulas += re.findall(r"\$\$(.+?)\$\$|(?<!\\)\$([^$\n]+?)\$", text, re.DOTALL)
    assert len(formulas) > 100
    for display, inline in formulas:
        assert mathml(display or inline, display=bool(display)).startswith("<math")
    assert mathml(r"a &= b \\ c &= d").count("<mtr>") == 2
    for unknown in (r"\nosuch x", r"\begin{nosuch} a & b \\ c & d \end{nosuch}"):
        with pytest.raises(ValueError, match="not known"):
            mathml(unknown)


@pytest.mark.slow
@pytest.mark.skipif(
    any(find_spec(name) is None for name in ("sphinx", "myst_nb", "furo", "do_mpc", "pyomo")),
    reason="the extra docs is not installed; make docs installs it",
)
def test_the_site_builds_without_a_warning(tmp_path):
    """Where `.ci/run` has built it, that site is looked at."""
    if "SPARSEROB_SITE" in os.environ:
        tmp_path = ROOT / os.environ["SPARSEROB_SITE"]
    else:
        build = [sys.executable, "-m", "sphinx", "-b", "html", "-W", "--keep-going", "-q", ROOT / "docs", tmp_path]
        done = subprocess.run(build, capture_output=True, text=True, timeout=1800, check=False)
        assert done.returncode == 0, done.stderr
    assert "\N{EN DASH}" not in re.sub(r"<code.*?</code>", "", (tmp_path / "reference.html").read_text())
    assert (tmp_path / "generated" / "components" / "maximiser" / "sequool.html").exists()
    assert not [page for page in tmp_path.rglob("*.html") if "<p>|" in page.read_text()], "a table that is none"
