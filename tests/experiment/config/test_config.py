"""Guards experiment/config: configs: every fault at once, each with its place, its key and what was expected; and
written back so that they run again."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import pytest

import sparserob_core as sr
from sparserob_core.experiment.assemble import assemble
from sparserob_core.experiment.config.load import load_config
from sparserob_core.experiment.config.reading.overrides import quoted
from sparserob_core.experiment.config.reading.reader import read_value, write_yaml

BILLION_LAUGHS = b"a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + b"".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n".encode() for i in range(1, 12)
)


def refusal(config: object, *overrides: str) -> str:
    """The message of the `ConfigError` that a config, or what is built from it, raises."""
    with pytest.raises(sr.ConfigError) as caught:
        assemble(load_config(config, overrides))  # type: ignore[arg-type]
    return str(caught.value)


def edited(config: Path, old: str, new: str) -> Path:
    text = config.read_text()
    assert old in text
    config.write_text(text.replace(old, new))
    return config


@pytest.mark.first(23)
@pytest.mark.parametrize(
    ("old", "new", "place", "said"),
    [
        ("horizon: 2.0", "horizn: 2.0", ":7:3: problem.horizn:", "did you mean 'horizon'?"),
        ("horizon: 2.0", "", ":2:1: problem.horizon:", "missing"),
        ("horizon: 2.0", "horizon: true", ":7:3: problem.horizon:", "must be a number (got true)"),
        ("horizon: 2.0", "horizon: '2'", ":7:3: problem.horizon:", "must be a number (got '2')"),
        ("horizon: 2.0", "horizon: null", ":7:3: problem.horizon:", "must be a number (got null)"),
        ("horizon: 2.0", "horizon: 2.0 \0", ":7:16:", "the character U+0000 is not allowed"),
        ("B: [[0], [1]]", "B: []", "problem.system.B", "must have at least 1 entry (got [])"),
        ("B: [[0], [1]]", "B: [[0], [1/0]]", ":6:15: problem.system.B.1.0:", "its value is not a finite number"),
        ("method: {name: stub}", "method: {name: stub}\nseed: true", ":14:1: seed:", "must be a number (got true)"),
        ("horizon: 2.0", "horizon: 0", ":7:3: problem.horizon:", "must be greater than 0 (got 0)"),
        ("horizon: 2.0", "horizon: -1e3", ":7:3: problem.horizon:", "must be greater than 0"),
        ("horizon: 2.0", "horizon: .nan", ":7:3: problem.horizon:", "must be a finite number (got nan)"),
        ("horizon: 2.0", "horizon: .inf", ":7:3: problem.horizon:", "must be a finite number (got inf)"),
        ("horizon: 2.0", "horizon: long", ":7:3: problem.horizon:", "must be a number"),
        (
            "horizon: 2.0",
            "horizon: 2020-01-01",
            ":7:3: problem.horizon:",
            "must be a number, a text, a list or a mapping",
        ),
        ("initial_state: [1, 0]", "initial_state: [1, 0, 0]", ":8:3: problem.initial_state:", "expected 2 numbers"),
        (
            "initial_state: [1, 0]",
            "initial_state: [1, .nan]",
            ":8:22: problem.initial_state.1:",
            "must be a finite number",
        ),
        ("B: [[0], [1]]", "B: [[0], [1], [2]]", ":6:5: problem.system.B:", "2 rows"),
        ("B: [[0], [1]]", "B: [0, 1]", "problem.system.B", "list"),
        ("control: {box: 1.0}", "control: {bax: 1.0}", ":9:13: problem.control.bax:", "did you mean 'box'?"),
        ("control: {box: 1.0}", "control: {box: {lower: 2, upper: 1}}", ":9:13: problem.control.box", "above"),
        (
            "horizon: 2.0",
            "horizon: 2.0\n  initial_control: 0.5",
            ":8:3: problem.initial_control:",
            "expected control_step or a system.delay beside it",
        ),
        ("pieces: 10", "pieces: ten", ":12:39: dictionaries.control.pieces:", "must be a whole number"),
        ("pieces: 10", "pieces: 0", ":12:39: dictionaries.control.pieces:", "greater than or equal to 1"),
        ("pieces: 10", "peices: 10", ":12:39: dictionaries.control.peices:", "did you mean 'pieces'?"),
        ("pieces: 10", "pieces: 10, functions: 11", "dictionaries.control", "11"),
        (
            "{name: piecewise_constant, ",
            "{name: piecewise, ",
            ":12:13: dictionaries.control.name:",
            "did you mean 'piecewise_constant'",
        ),
        ("name: linear", "name: linaer", ":3:3: problem.name:", "did you mean 'linear'"),
        ("method: {name: stub}", "method: {nmae: stub}", ":13:10: method.nmae:", "unknown key"),
        ("method: {name: stub}", "method: 3", ":13:1: method:", "must be a mapping (got 3)"),
        ("method: {name: stub}", "metod: {name: stub}", ":13:1: metod:", "did you mean 'method'?"),
        ("method: {name: stub}", "method: stub\nhorizn: 3", ":14:1: horizn:", "did you mean 'problem.horizon'?"),
        ("method: {name: stub}", "method: {name: stub}\nseed: -1", ":14:1: seed:", "greater than or equal to 0"),
        ("method: {name: stub}", "method: {name: stub}\nseed: one", ":14:1: seed:", "must be a whole number"),
        ("method: {name: stub}", "method: {name: stub}\nmethod: stub", ":14:1:", "duplicate key"),
        (
            "method: {name: stub}",
            "method: {name: stub}\ncontinuation: {factor: 2}",
            ":14:16: continuation.factor:",
            "less than 1",
        ),
        (
            "method: {name: stub}",
            "method: {name: stub}\nmaximiser: {name: direct, budget: 0}",
            ":14:27: maximiser.budget:",
            "equal to 1",
        ),
        (
            "method: {name: stub}",
            "method: {name: stub}\nobservers: [progres]",
            ":14:13: observers.0.name:",
            "did you mean 'progress'?",
        ),
        ("method: {name: stub}", "method: {name: stub}\nobservers: progress", ":14:1: observers:", "must be a list"),
        ("title: A double integrator", "title: [a]", ":1:1: title:", "must be text"),
        ("title: A double integrator", "3: 4", ":1:1: 3:", "a key must be text"),
        ("title: A double integrator", "title: &a [*a]", ":1:8: title.0:", "contains itself"),
        ("  horizon", "\thorizon", ":7:1:", "indent with spaces"),
        ("[[0], [1]]", "[[0], [1]", ":7:", "not valid YAML"),
        ("horizon: 2.0", "horizon: !!python/object:os.system 2", ":7:12:", "not valid YAML"),
        ("./stub.py", "./stubb.py", ":14:1: plugins:", "no such plugin"),
        ("plugins: [./stub.py]", "plugins: stub.py", ":14:1: plugins:", "must be a list"),
    ],
)
def test_a_fault_is_told_with_its_place_its_key_and_what_was_expected(
    config: Path, old: str, new: str, place: str, said: str
) -> None:
    message = refusal(edited(config, old, new))
    assert any(place in line and said in line for line in message.splitlines()), message


def test_a_misspelt_key_is_told_once_and_not_as_missing_too(config: Path) -> None:
    assert len(refusal(edited(config, "horizon: 2.0", "horizn: 2.0")).splitlines()) == 1


def test_all_faults_are_told_at_once_in_the_order_of_the_file(config: Path) -> None:
    edited(config, "horizon: 2.0", "horizon: -2")
    edited(config, "pieces: 10", "pieces: ten")
    edited(config, "title:", "tittle:")
    lines = refusal(config, "method.rounds=many", "solver=piq").splitlines()
    assert [line.split(" ")[0].removeprefix(str(config)) for line in lines] == [
        ":1:1:",
        ":7:3:",
        ":12:39:",
        "override",
        "override",
    ]


def test_the_missing_problem_is_the_only_key_without_a_default(config: Path) -> None:
    config.write_text("title: nothing\n")
    assert refusal(config) == f"{config}:1:1: problem: missing, and it has no default"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "the file is empty"),
        (b"# only a comment\n", "the file is empty"),
        (b"- 1\n- 2\n", "expected a mapping of keys to values, got a list"),
        (b"just text", "expected a mapping"),
        (b"title: \xff\n", "expected text in UTF-8, got the byte 0xff at 7"),
        (b"a: 1\n---\nb: 2\n", "not valid YAML"),
        (b"[" * 1200, "nested too deeply"),
        (b"x: [" + b"1," * 5_000_000 + b"1]", "expected at most 4000000 bytes, got 10000006"),
        (BILLION_LAUGHS, "expected at most 200000 values, aliases counted as what they stand for"),
    ],
)
def test_a_file_that_holds_no_config_gets_one_sentence(tmp_path: Path, content: bytes, said: str) -> None:
    file = tmp_path / "odd.yaml"
    file.write_bytes(content)
    message = refusal(file)
    assert said in message
    assert len(message.splitlines()) == 1


def test_a_missing_file_and_a_directory_are_told_apart(tmp_path: Path) -> None:
    assert "there is no such file" in refusal(tmp_path / "nothing.yaml")
    assert "is a directory, expected a file" in refusal(tmp_path)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("method.rouns=3", "override method.rouns=3: method.rouns: unknown key; did you mean 'rounds'?"),
        ("methd.rounds=3", "override methd.rounds=3: methd: unknown key; did you mean 'method'?"),
        ("horizon=3", "override horizon=3: horizon: unknown key; did you mean 'problem.horizon'?"),
        ("rouns=3", "override rouns=3: rouns: unknown key; did you mean 'method.rounds'?"),
        ("seconds=3", "override seconds=3: seconds: unknown key; did you mean 'limits.seconds'?"),
        ("control.box=3", "override control.box=3: control: unknown key; did you mean 'problem.control'?"),
        ("peices=3", "did you mean 'dictionaries.control.pieces'?"),
        ("xyzzy=3", "override xyzzy=3: xyzzy: unknown key; known: continuation, "),
        ("problem.horizon=.nan", "override problem.horizon=.nan: problem.horizon: must be a finite number"),
        ("problem.horizon=", "override problem.horizon=: problem.horizon: must be a number"),
        ("problem.horizon", "expected key=value"),
        ("=3", "expected a key"),
        ("a..b=3", "expected a key"),
        ("seed=[1", "not valid YAML"),
        (
            "title=run #5",
            """'#5' would be a comment, which is left out; as text the value is written 'title="run #5"'""",
        ),
        ("title=#5", """as text the value is written 'title="#5"'"""),
        ("seed=3 # of three", "'# of three' would be a comment"),
        ("title=*", """as text it is written 'title="*"'"""),
        ("title=@file", """as text it is written 'title="@file"'"""),
        ("title=012", """title: must be text (got 12); as text it is written 'title="012"'"""),
        ("title=1e3", """must be text (got 1000.0); as text it is written 'title="1e3"'"""),
        ("title=|", """'|' reads as an empty text; as text it is written 'title="|"'"""),
        ("title=2024-11-28", """(got datetime.date(2024, 11, 28)); as text it is written 'title="2024-11-28"'"""),
        ("title=?", """a key must be text (got null); as text it is written 'title="?"'"""),
        ("problem.terminal.3.box=1", "problem.terminal is a list with 1 entries"),
        ("problem.terminal.first.box=1", "expected a number of at most 1, got 'first'"),
        ("problem.horizon.x=1", "problem.horizon is 2.0, which has no key 'x'"),
    ],
)
def test_an_override_at_fault_is_told_like_a_key_at_fault(config: Path, override: str, said: str) -> None:
    assert said in refusal(config, override)


@pytest.mark.parametrize("text", ["run #5", "#5", "*", "@file", "012", "1e3", 'a "b" # c', "it's", "a\\b #", "|"])
def test_a_value_that_is_written_as_the_refusal_says_is_that_text(text: str, config: Path) -> None:
    (argument,) = shlex.split(quoted(f"title={text}"))
    assert load_config(config, [argument]).config.title == text


def test_a_mark_within_a_word_or_within_quotes_begins_no_comment(config: Path) -> None:
    assert load_config(config, ["title=run#5"]).config.title == "run#5"
    assert load_config(config, ["title='run #5'"]).config.title == "run #5"


def test_overrides_reach_into_lists_and_make_what_is_missing(config: Path) -> None:
    changes = [
        "problem.terminal.0.box=[0.4, 0.4]",
        "problem.disturbance.box=[1e-3, 1e-3]",
        "problem.path.0.box=[2, null]",
        "problem.path.0.from=0.3",
        "observers.0.name=progress",
        "solver=clarabel",
        "method.rounds=3",
        "seed=7",
    ]
    plain = load_config(config, changes).config.plain()
    problem = plain["problem"]
    assert problem["terminal"][0]["box"] == [0.4, 0.4]
    assert problem["disturbance"]["box"] == [0.001, 0.001]
    assert problem["path"][0]["box"] == [2.0, None]
    assert problem["path"][0]["from"] == 0.3
    assert (plain["solver"]["name"], plain["method"]["name"], plain["method"]["rounds"], plain["seed"]) == (
        "clarabel",
        "stub",
        3,
        7,
    )


def test_a_plugin_named_on_the_command_line_is_looked_for_in_the_working_directory(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (config.parent / "stub.py").rename(elsewhere / "stub.py")
    monkeypatch.chdir(elsewhere)
    assert load_config(config, ["plugins=[stub.py]"]).config.plugins == (str(elsewhere / "stub.py"),)


def test_overrides_from_python_are_a_mapping(config: Path) -> None:
    loaded = load_config(config, {"method.rounds": 5, "problem.initial_state": (0.5, 0)})
    assert loaded.config.method.options["rounds"] == 5
    assert loaded.config.problem.options["initial_state"] == [0.5, 0.0]


def test_values_are_yaml_of_version_1_2() -> None:
    assert [read_value(text) for text in ("1e-6", "on", "[1, null]", "", "0o17", "'3'")] == [
        1e-6,
        "on",
        [1, None],
        None,
        15,
        "3",
    ]


def test_the_defaults_are_those_that_are_documented(config: Path) -> None:
    config.write_text(config.read_text().split("dictionaries:")[0])
    plain = load_config(config).config.plain()
    assert plain["dictionaries"]["control"]["pieces"] == 100
    assert plain["dictionaries"]["disturbance"] is None
    names = {key: plain[key]["name"] for key in ("regulariser", "method", "maximiser", "solver")}
    assert names == {"regulariser": "ridge", "method": "exchange", "maximiser": "direct", "solver": "auto"}
    assert [entry["name"] for entry in plain["observers"]] == ["progress"]


def test_the_resolved_config_says_the_same_when_it_is_read_again(config: Path, tmp_path: Path) -> None:
    first = load_config(config, ["maximiser.budget=77", "problem.path.0.box=[2, null]"]).config
    again = tmp_path / "elsewhere" / "config.yaml"
    again.parent.mkdir()
    again.write_text(write_yaml(first.plain(), "a heading"))
    second = load_config(again).config
    assert second.plain() == first.plain()
    assert second.digest() == first.digest() != load_config(config).config.digest()


def test_json_and_toml_are_read_too(config: Path, tmp_path: Path) -> None:
    plain: dict[str, Any] = load_config(config).config.plain()
    as_json = tmp_path / "small.json"
    as_json.write_text(json.dumps(plain))
    assert load_config(as_json).config.plain() == plain
    as_json.write_text('{"title": }')
    assert ":1:11: not valid JSON" in refusal(as_json)
    as_toml = tmp_path / "small.toml"
    as_toml.write_text('title = "t"\n[problem]\nname = "linear"\nhorizon = -1\n')
    assert f"{as_toml}: problem.horizon: must be greater than 0" in refusal(as_toml)


def test_a_mapping_is_a_config(config: Path) -> None:
    plain = load_config(config).config.plain()
    assert load_config(plain).config.plain() == plain
    assert refusal({**plain, "seed": -1}).startswith("config: seed:")
    assert "must be a number, a text, a list or a mapping" in refusal({**plain, "title": object()})


def test_the_given_mapping_is_not_changed(config: Path) -> None:
    plain = load_config(config).config.plain()
    before = json.dumps(plain)
    load_config(plain, ["seed=4", "method.rounds=9"])
    assert json.dumps(plain) == before
