"""Guards plugins/sparserob_sets and the hook sparserob_sets: a set of a plugin works wherever a set is written, and
says the same as one that is built in."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.config.load import load_config
from sparserob_core.experiment.config.schema import config_schema

SETS = sr.load_registry().names("set")
pytestmark = pytest.mark.skipif("zonotope" not in SETS, reason="the plugin sets is not installed")

BOXES = {
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "horizon": 2.0,
        "initial_state": [1, 0],
        "control": {"box": 2.0},
        "disturbance": {"box": [0.02, 0.01]},
        "path": [{"box": {"lower": [-0.2, -1.2], "upper": [1.4, 0.4]}}],
        "terminal": [{"box": [0.2, 0.3]}],
    },
    "dictionaries": {"control": {"pieces": 10}},
    "observers": [],
}
AS_ZONOTOPE = {
    "control": {"zonotope": {"generators": [[0.5], [1.5]]}},
    "disturbance": {"zonotope": {"generators": [[0.02, 0.0], [0.0, 0.006], [0.0, 0.004]]}},
    "path": [{"zonotope": {"generators": [[0.8, 0.0], [0.0, 0.8]], "centre": [0.6, -0.4]}}],
    "terminal": [{"zonotope": {"generators": [[0.2, 0.0], [0.0, 0.3]]}}],
}

# A third party's set: a disc, by the three members that every set must have.
DISC = '''
from typing import ClassVar

import numpy as np
import sparserob_core as sr


class Disc(sr.ConvexSet):
    dimension = 2

    def __init__(self, radius):
        self.radius = radius

    def support(self, directions):
        return self.radius * np.linalg.norm(directions, axis=-1)

    def support_point(self, directions):
        lengths = np.linalg.norm(directions, axis=-1, keepdims=True)
        return self.radius * directions / np.where(lengths > 0, lengths, 1.0)


class DiscFactory(sr.SetFactory, sr.Options):
    shorthand: ClassVar[str | None] = "radius"

    radius: float
    """Radius."""

    def build(self, dimension):
        return Disc(self.radius)


@sr.hookimpl
def sparserob_sets():
    yield sr.SetPlugin(name="disc", factory=DiscFactory, summary="A disc about the origin.")
'''


def changed(**parts) -> dict:
    config = copy.deepcopy(BOXES)
    config["problem"] |= parts
    return config


def cost(config, out: Path) -> float:
    outcome = sr.run(config, out=out, quiet=True, figures=False)
    assert outcome.result.status == "certified", outcome.result.message
    return outcome.result.upper_bound


@pytest.fixture(scope="module")
def of_boxes(tmp_path_factory) -> float:
    return cost(BOXES, tmp_path_factory.mktemp("boxes") / "run")


@pytest.mark.first(2)
@pytest.mark.parametrize("part", AS_ZONOTOPE)
def test_a_box_written_as_a_zonotope_gives_the_same_answer(part, of_boxes, tmp_path):
    assert cost(changed(**{part: AS_ZONOTOPE[part]}), tmp_path / "run") == pytest.approx(of_boxes, rel=1e-6)


@pytest.fixture(scope="module")
def zonotopes(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("zonotopes") / "run"
    cost(changed(**AS_ZONOTOPE), out)
    return out


def test_every_claim_about_zonotopes_is_checked(zonotopes):
    pytest.importorskip("flint")
    found = sr.check(zonotopes)
    assert found.status == "verified", [claim for claim in found.claims if claim.verdict != "holds"]


# Slanted segments, more of them than dimensions, in the plane and in space, wherever a set is written.
SLANTED = changed(
    control={"zonotope": {"generators": [[1.5], [0.5]]}},
    disturbance={"zonotope": {"generators": [[0.01, 0.005], [0.0, 0.004], [-0.003, 0.007]]}},
    path=[{"zonotope": {"generators": [[0.7, 0.1], [0.2, 0.9], [0.2, -0.3]], "centre": [0.6, -0.4]}}],
    terminal=[{"zonotope": {"generators": [[0.15, 0.1], [0.1, -0.2], [0.1, 0.0]]}}],
)
SOLID = changed(
    system={
        "A": [[0, 1, 0], [0, 0, 1], ["p", -1, -1]],
        "B": [[0, 0], [1, 0.2], [0, 1]],
        "parameters": {"p": [-0.1, 0.1]},
    },
    initial_state=[1, 0, 0],
    control={"zonotope": {"generators": [[1.5, 0.3], [0.5, -1.0], [0.2, 0.2]]}},
    disturbance={"zonotope": {"generators": [[0.01, 0.005, 0], [0, 0.004, 0.01], [-0.003, 0, 0.007], [0.001] * 3]}},
    path=[{"zonotope": {"generators": [[1.1, 0.1, 0.2], [0, 1.9, 0.1], [0.1, 0.3, 2.0], [0.5, 0.5, -0.5]]}}],
    terminal=[{"zonotope": {"generators": [[0.3, 0.1, 0], [0, 0.3, 0.1], [0.1, 0, 0.3], [0.1, 0.1, 0.1]]}}],
)


@pytest.mark.first(1)
@pytest.mark.parametrize("config", [SLANTED, SOLID], ids=["plane", "space"])
def test_every_claim_about_slanted_zonotopes_is_checked(config, tmp_path):
    pytest.importorskip("flint")
    cost(config, tmp_path / "run")
    found = sr.check(tmp_path / "run")
    assert found.status == "verified", [claim for claim in found.claims if claim.verdict != "holds"]


def test_a_zonotope_that_is_left_is_refuted_by_a_disturbance_that_is_checked(tmp_path):
    pytest.importorskip("flint")
    config = copy.deepcopy(SLANTED) | {"method": {"name": "nominal"}}
    assert sr.run(config, out=tmp_path / "run", quiet=True, figures=False).result.status == "refuted"
    found = sr.check(tmp_path / "run")
    assert found.status == "verified", [claim for claim in found.claims if claim.verdict != "holds"]


def test_no_random_trajectory_leaves_a_zonotope_that_was_proven(zonotopes):
    for law in ("iid", "vertices"):
        assert not any(share.violated for share in sr.simulate(zonotopes, 500, law).constraints)


@pytest.mark.slow
@pytest.mark.parametrize("of", ["disturbance", "path.0", "terminal.0", "control"])
def test_a_margin_scales_a_zonotope_as_it_scales_the_box(of):
    boxes, others = (sr.margin(config, of, tolerance=1e-4) for config in (BOXES, changed(**AS_ZONOTOPE)))
    assert others.status == boxes.status
    assert others.feasible.factor == pytest.approx(boxes.feasible.factor, abs=3e-4)


def test_a_config_with_sets_is_written_as_it_was_read():
    config = load_config(
        changed(**AS_ZONOTOPE | {"path": [{"box": [1, None], "zonotope": {"generators": [[1, 0], [0, 1]]}}]})
    )
    problem = config.config.plain()["problem"]
    assert problem["path"][0]["box"] == [1.0, None]
    assert problem["control"] == {"zonotope": {"generators": [[0.5], [1.5]], "centre": 0.0}}
    assert load_config(config.config.plain()).config.digest() == config.config.digest()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"zonotop": 1}, "problem.control.zonotop: unknown key; did you mean 'zonotope'?"),
        ({"zonotope": 1}, "problem.control.zonotope: must be a mapping (got 1)"),
        ({"zonotope": {"generater": [[1.0]]}}, "problem.control.zonotope.generater: unknown key"),
        ({"zonotope": {}}, "problem.control.zonotope.generators: missing"),
        ({"zonotope": {"generators": [["a"]]}}, "problem.control.zonotope.generators.0.0: must be a number"),
        ({"zonotope": {"generators": [[1.0, 2.0]]}}, "every generator must have 1 numbers"),
        ({"box": "wide"}, "problem.control.box: expected a half-width"),
        ({"box": {"lower": 0, "half_widths": 1}}, "problem.control.box: expected half_widths, or lower and upper"),
        ({"box": None}, "problem.control: expected a set"),
        (3, "problem.control: must be a mapping (got 3)"),
    ],
)
def test_a_set_at_fault_is_told_with_its_key_and_what_was_expected(given, said):
    with pytest.raises(sr.InputError) as error:
        sr.run(changed(control=given), quiet=True, figures=False)
    assert said in str(error.value)


def test_the_schema_knows_the_keys_of_every_set():
    jsonschema = pytest.importorskip("jsonschema")
    schema = config_schema(sr.load_registry())
    validator = jsonschema.Draft202012Validator(schema)
    validator.validate(json.loads(json.dumps(changed(**AS_ZONOTOPE))))
    for wrong in ({"zonotop": {"generators": [[1.0]]}}, {"zonotope": {"generators": 3}}, {"zonotope": {}}):
        assert not validator.is_valid(changed(control=wrong))


@pytest.fixture
def disc(tmp_path) -> str:
    (tmp_path / "disc.py").write_text(DISC)
    return str(tmp_path / "disc.py")


@pytest.mark.first(1)
@pytest.mark.parametrize("part", ["path", pytest.param("terminal", marks=pytest.mark.slow), "disturbance"])
def test_a_set_of_a_file_with_three_members_works_as_the_norm_that_it_is(part, disc, tmp_path):
    radius = {"path": 1.3, "terminal": 0.4, "disturbance": 0.02}[part]
    own, known = {"disc": radius}, {"norm": {"p": 2, "radius": radius}}
    found = []
    for name, value in (("own", own), ("known", known)):
        config = changed(**{part: value if part == "disturbance" else [value]}) | {"plugins": [disc]}
        found.append(cost(config, tmp_path / name))
    assert found[0] == pytest.approx(found[1], rel=1e-6)


def test_a_zonotope_has_the_facets_that_its_generators_span():
    hexagon = sr.load_registry().build("set", "zonotope", {"generators": [[1, 0], [0, 1], [1, 1]]}).build(2)
    H, h = hexagon.halfspaces()
    assert len(np.unique(np.round(H, 9), axis=0)) == 6
    assert h == pytest.approx(hexagon.support(H))
    flat = sr.load_registry().build("set", "zonotope", {"generators": [[1, 1]]}).build(2)
    across, room = flat.halfspaces()  # of a segment its ends, and what it does not reach across
    assert np.abs(across @ np.array([1.0, -1.0])) == pytest.approx(np.array([0.0, 2.0] * 2) / np.sqrt(2.0), abs=1e-12)
    assert (across[:2] == -across[2:]).all() and room == pytest.approx(flat.support(across), abs=1e-12)
    assert flat.support(np.array([[1.0, -1.0], [1.0, 1.0]])) == pytest.approx([0.0, 2.0])


@pytest.mark.slow
def test_parameters_in_a_zonotope_give_the_answer_of_the_same_polytope(tmp_path):
    system = {"A": [[0, 1], ["-1 + p1", "-0.2 + p2"]], "B": [[0], [1]]}
    zonotope = {"zonotope": {"generators": [[0.05, 0.0], [0.03, 0.04]]}}
    polytope = {"polytope": {"H": [[0, 1], [0, -1], [1, -0.75], [-1, 0.75]], "h": [0.04, 0.04, 0.05, 0.05]}}
    found = [
        cost(changed(system=system | {"parameters": {"names": ["p1", "p2"], **one}}, path=[]), tmp_path / name)
        for name, one in (("zonotope", zonotope), ("polytope", polytope))
    ]
    assert found[0] == pytest.approx(found[1], rel=1e-6)


@pytest.mark.slow
def test_a_run_with_a_set_of_a_file_is_checked_with_that_file_only(disc, tmp_path):
    pytest.importorskip("flint")
    cost(changed(terminal=[{"disc": 0.4}]) | {"plugins": [disc]}, tmp_path / "run")
    with pytest.raises(sr.InputError, match=r"terminal\.0\.disc: unknown key(.|\n)*--plugins FILE"):
        sr.check(tmp_path / "run")
    found = sr.check(tmp_path / "run", plugins=[disc])
    assert {claim.name: claim.verdict for claim in found.claims}["terminal"] == "not checked"
    assert found.status == "undecided"


def test_a_missing_kind_says_which_plugin_is_disabled(monkeypatch):
    monkeypatch.setenv("SPARSEROB_DISABLE_PLUGINS", "sets")
    with pytest.raises(sr.InputError, match=r"problem\.control\.box: unknown key(.|\n)*'sets' is disabled"):
        sr.run(BOXES, quiet=True, figures=False)
