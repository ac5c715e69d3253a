"""Guards `sparserob examples`: every config is listed with its story, copied whole, and nothing is overwritten."""

from pathlib import Path

from sparserob_core.experiment.config.examples import _complete_text, examples
from sparserob_core.experiment.config.load import load_config
from sparserob_core.experiment.config.reading.reader import read_value
from tests.support.stub import Command


def test_every_config_is_listed_with_its_story(repository: Path, command: Command):
    printed = command("examples").stdout
    for file in sorted((repository / "configs").glob("*.yaml")):
        line = next(line for line in printed.splitlines() if line.split()[:1] == [file.stem])
        assert len(line.split()) > 8, f"{file.name} begins with no comment that says what it is about"


def test_an_example_is_copied_and_means_the_same(repository: Path, command: Command, tmp_path: Path):
    done = command("examples", "double_integrator", "--out", str(tmp_path / "new"))
    file = tmp_path / "new" / "double_integrator.yaml"
    assert done.stdout == f"written to {file}; next: sparserob run {file}\n"
    assert load_config(file).config == load_config(repository / "configs" / "double_integrator.yaml").config
    assert "yaml-language-server" not in file.read_text()


def test_every_example_is_complete_and_means_what_its_config_does(repository: Path, tmp_path: Path):
    extending = []
    for one in examples():
        file, copied = repository / "configs" / f"{one.name}.yaml", tmp_path / f"{one.name}.yaml"
        copied.write_text(one.text)
        assert "extends:" not in one.text
        assert load_config(copied).config == load_config(file).config, one.name
        if "\nextends:" in file.read_text():
            extending.append(one)
    assert extending and all("# |u| <= 1" in one.text for one in extending if one.name.startswith("experiment1"))


def test_what_cannot_be_composed_of_two_texts_is_written_as_data(tmp_path: Path):
    (tmp_path / "base.yaml").write_text("# base\nmethod: {name: exchange, tolerance: 1.0e-3}\nseed: 1\n")
    (tmp_path / "child.yaml").write_text("# child\nextends: base.yaml\nmethod: {name: exchange, rounds: 7}")
    text = _complete_text(tmp_path / "child.yaml")
    assert text.startswith("# child\n")
    assert read_value(text) == {"method": {"name": "exchange", "tolerance": 1e-3, "rounds": 7}, "seed": 1}


def test_nothing_is_overwritten_and_a_wrong_name_is_one_error(command: Command, tmp_path: Path):
    (tmp_path / "haar.yaml").write_text("mine")
    done = command("examples", "haar", "--out", str(tmp_path))
    assert "expected no file of that name, which would be overwritten" in done.stderr
    assert (tmp_path / "haar.yaml").read_text() == "mine"
    done = command("examples", "harr", "--out", str(tmp_path))
    assert "there is none called 'harr'; did you mean 'haar'?" in done.stderr
    done = command("examples", "walsh", "--out", str(tmp_path / "haar.yaml"))
    assert (done.returncode, done.stderr.lower().count("error:")) == (2, 1)
