"""Guards experiment/config/matrices/text_tables: tables of programs, and matrices, come from files of text, and from
the run directory afterwards."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.errors import ConfigError, InputError
from sparserob_core.experiment.config.load import load_config
from sparserob_core.experiment.config.matrices import text_tables
from sparserob_core.experiment.config.matrices.text_tables import read_table

CONFIG = """
problem:
  name: program
  decision: {x: {size: 2, lower: 0}, r: {}}
  minimise: -r
  rows: ["x[0] + x[1] == 1"]
  tables: {m: {file: m.csv}, C: {file: data/C.csv}}
  families:
    - {name: f, index: {t: [0, 1]}, rows: ["r <= sum((m[i] + C[i, 1]*t)*x[i] for i in range(2))"]}
regulariser: null
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    (tmp_path / "data").mkdir()
    (tmp_path / "m.csv").write_text("# means\n3\n1.5\n")
    (tmp_path / "data" / "C.csv").write_text("9,-2\n9,0.5\n")
    (tmp_path / "config.yaml").write_text(CONFIG)
    return tmp_path / "config.yaml"


FORMS = {
    "commas": "1, -2e3,3\n4,5,6.5\n",
    "semicolons": "1;-2e3; 3\n4;5;6.5",
    "blanks and tabs": "1 -2000\t3\n  4  5 6.5  \n",
    "comments, empty lines, a mark of the order of bytes": "\ufeff# a,b,c\r\n\r\n1,-2000,3 # one\r\n4,5,6.5\r\n",
}


@pytest.mark.parametrize("form", FORMS)
def test_numbers_stand_between_commas_semicolons_or_blanks(form: str, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_bytes(FORMS[form].encode())
    assert read_table(tmp_path / "t.csv").array.tolist() == [[1.0, -2000.0, 3.0], [4.0, 5.0, 6.5]]


FAULTS: dict[str, tuple[bytes, str]] = {
    "a heading": (b"a,b\n1,2\n", "t.csv: expected numbers in line 1 (a heading begins with #), got 'a'"),
    "a word": (b"1,2\n3,four\n", "t.csv: expected numbers in line 2, got 'four'"),
    "nothing between commas": (b"1,2\n3,\n", "t.csv: expected numbers in line 2, got ''"),
    "a number of Python": (b"1,2\n1_000,2\n", "t.csv: expected numbers in line 2, got '1_000'"),
    "ragged": (b"1,2\n\n3\n", "t.csv: expected 2 numbers in line 3, as in the first, got 1"),
    "nothing": (b"# only a comment\n", "t.csv: expected at least one row of numbers, got none"),
    "NaN": (b"1,2\n3,nan\n", "t.csv: expected finite numbers, got nan at (2, 2)"),
    "infinite": (b"1e999\n", "t.csv: expected finite numbers, got inf at (1, 1)"),
    "other letters": (b"\xff\xfe1\x00", "t.csv: expected text in UTF-8"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_file_at_fault_is_refused_with_its_line(fault: str, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_bytes(FAULTS[fault][0])
    with pytest.raises(InputError) as caught:
        read_table(tmp_path / "t.csv")
    assert str(caught.value).startswith(FAULTS[fault][1])


def test_a_file_that_is_too_large_is_refused_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "t.csv").write_text("1\n2\n")
    monkeypatch.setattr(text_tables, "MAX_TABLE_BYTES", 4)
    assert read_table(tmp_path / "t.csv").column == [1.0, 2.0]
    monkeypatch.setattr(text_tables, "MAX_TABLE_BYTES", 3)
    with pytest.raises(InputError, match="at most 3 bytes"):
        read_table(tmp_path / "t.csv")


@pytest.mark.slow
def test_a_run_needs_no_file_once_it_is_written(config: Path, tmp_path: Path) -> None:
    result = sr.run(config, {"observers": []}, out=tmp_path / "run", figures=False).result
    # r is the least of m x and (m + C t) x at t = 1, where both entries give 1 and 2
    assert result.status == "certified"
    assert result.cost == pytest.approx(-max(min(3 - 1.5 * s, 1 + s) for s in np.linspace(0, 1, 100_001)), abs=1e-5)
    (tmp_path / "m.csv").unlink()
    (tmp_path / "data" / "C.csv").unlink()
    assert ".csv" not in (tmp_path / "run" / "config.yaml").read_text()
    assert [claim for claim in sr.check(tmp_path / "run").claims if claim.verdict != "holds"] == []
    again = sr.run(tmp_path / "run" / "config.yaml", {"observers": []}, out=tmp_path / "again", figures=False)
    assert again.result.cost == result.cost


@pytest.mark.parametrize("table", ["1\n2\n3\n", "1,2,3\n"])
def test_one_row_or_one_column_is_a_list(config: Path, table: str) -> None:
    config.with_name("m.csv").write_text(table)
    assert load_config(config).config.problem.tables["m"] == [1.0, 2.0, 3.0]


WRONG: dict[str, tuple[Any, str]] = {
    "no file": ({"file": "none.csv"}, "none.csv, which is none"),
    "a folder": ({"file": "folder.csv"}, "which is none"),
    "a name": ({"file": "m.csv", "name": "m"}, "expected no name"),
    "another kind": ({"file": "m.txt"}, "expected a file whose name ends with .npz or .csv"),
    "arrays without a name": ({"file": "m.npz"}, "expected the name of a matrix in the file"),
}


@pytest.mark.parametrize("fault", WRONG)
def test_what_names_no_table_is_refused_with_its_key(config: Path, fault: str) -> None:
    config.with_name("folder.csv").mkdir()
    reference, message = WRONG[fault]
    with pytest.raises(ConfigError) as caught:
        load_config(config, {"problem.tables.m": reference})
    assert "problem.tables.m" in str(caught.value)
    assert message in str(caught.value)


def test_a_name_that_is_file_stays_a_name(config: Path) -> None:
    text = CONFIG.replace("m: {file: m.csv}, C: {file: data/C.csv}", "file: [1.0, 2.0]")
    config.write_text(text.replace("(m[i] + C[i, 1]*t)", "file[i]"))
    assert load_config(config).config.problem.tables["file"] == [1.0, 2.0]
