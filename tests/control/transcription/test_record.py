"""Guards the transcription's record: families know their constraint and their formulation, and a constraint from
another initial state is that of the problem stated afresh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.constraints.curved import CurvedConstraint
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.transcription import record
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.control.transcription.transcribe import from_state, prepare
from sparserob_core.sip.evidence import Cut
from tests.support.plants import uniform

SPRING = sr.LinearSystem(A=[[0, 1], [-2, -0.5]], B=[[0], [1]])
UNCERTAIN = sr.LinearSystem(
    A=lambda p: np.stack(
        [np.stack([0 * p[..., 0], 1 + 0 * p[..., 0]], -1), np.stack([-2 + p[..., 0], -0.5 + 0 * p[..., 0]], -1)], -2
    ),
    B=[[0], [1]],
    parameters=sr.Box([-0.1], [0.1]),
)
BALL = sr.Ellipsoid(centre=[0, 0], shape=[[0.25, 0], [0, 0.25]])
BOX = sr.Box([-0.5, -0.5], [0.5, 0.5])
CASES = {
    "flat": (SPRING, BOX, "piecewise_constant"),
    "measurable": (SPRING, BOX, "measurable"),
    "curved": (SPRING, BALL, "piecewise_constant"),
    "uncertain": (UNCERTAIN, BOX, "piecewise_constant"),
    "uncertain and curved": (UNCERTAIN, BALL, "piecewise_constant"),
}


def model_of(name: str, state: tuple[float, float] = (-1.0, 1.0), formulation: str = "reduced") -> Transcription:
    system, end, kind = CASES[name]
    problem = sr.OptimalControlProblem(
        system=system,
        horizon=2.0,
        initial_state=list(state),
        control=sr.NormBall(p=2, radius=1.0, centre=[0.0]) if name == "flat" else sr.Box([-1], [1]),
        disturbance=sr.Box([-0.05, -0.05], [0.05, 0.05]),
        disturbance_class=kind,
        path=[sr.PathConstraint(sr.Box([-2, -9], [2, 9]), 0.5)],
        terminal=[end],
    )
    return prepare(problem, uniform(8, 2.0), uniform(8, 2.0), formulation)


@pytest.mark.parametrize("name", CASES)
def test_every_form_of_a_family_names_its_constraint_and_what_its_indices_say(name: str) -> None:
    model = model_of(name)
    assert [model.family(one).name for one in model.constraints] == ["path", "terminal"]
    for constraint in model.constraints:
        family = model.family(constraint)
        literal = family.formulated("literal")
        assert literal is not None and family.formulated("sampled") is None
        assert family.formulated("nominal").formulation == "nominal"
        assert literal.formulated("reduced").formulation == family.formulation == "reduced"
        forms = [family, literal, literal.reduced, family.nominal]
        if constraint.sides is not None and name != "measurable":
            forms.append(family.sample(3, np.random.default_rng(0)))
            assert forms[-1].formulation == "sampled"
        assert all(model.constraint(form) is constraint for form in forms)


@pytest.mark.parametrize("name", CASES)
def test_single_rows_and_violations_of_a_family_are_those_of_all_its_rows(name: str) -> None:
    model, rng = model_of(name), np.random.default_rng(7)
    for family in model.program.families:
        box, x = family.index_set, rng.uniform(-1, 1, model.program.n)
        indices = rng.uniform(box.lower, box.upper, size=(6, box.dimension))
        G, h = family.rows(indices)
        rows = rng.integers(h.shape[1], size=6)
        assert family.chosen is not None
        one, rhs = family.chosen(indices, rows)
        np.testing.assert_allclose(one, G[np.arange(6), rows], atol=1e-12)
        np.testing.assert_allclose(rhs, h[np.arange(6), rows], atol=1e-12)
        np.testing.assert_allclose(family.violations(x, indices), G @ x - h, atol=1e-11)
        assert family.violations(x, indices[:0]).size == 0


@pytest.mark.parametrize("name", CASES)
def test_a_constraint_from_another_state_is_that_of_the_problem_stated_afresh(name: str) -> None:
    model, rng = model_of(name), np.random.default_rng(3)
    for state in ((0.3, -0.2), (-0.4, 0.9)):
        moved, fresh = from_state(model, np.array(state)), model_of(name, state)
        x = rng.uniform(-1, 1, fresh.program.n)
        for one, two in zip(moved.program.families, fresh.program.families, strict=True):
            here, there = one.worst(x), two.worst(x)
            np.testing.assert_allclose(here.violations, there.violations, atol=1e-12)
            np.testing.assert_allclose(one.rows(there.indices)[1], two.rows(there.indices)[1], atol=1e-12)
            if two.enclosure is not None and name not in ("uncertain", "uncertain and curved"):
                bounds = [form.enclosure(x, *form.cells).bounds for form in (one, two)]
                np.testing.assert_allclose(*bounds, atol=1e-12)


def test_what_does_not_depend_on_the_state_is_shared_and_by_no_constraint_that_differs() -> None:
    constraint = model_of("flat").constraints[0]
    moved = constraint.from_state(np.array([0.1, 0.2]))
    assert isinstance(constraint, FlatConstraint)
    assert isinstance(moved, FlatConstraint)
    assert moved.samples is constraint.samples
    assert moved.functionals.response.propagator is constraint.functionals.response.propagator
    assert replace(moved, h=moved.h + 1.0).samples is not constraint.samples
    assert replace(moved, stop=1.0).times[-1] == 1.0
    curved = model_of("curved").constraints[1].from_state(np.array([0.1, 0.2]))
    assert isinstance(curved, CurvedConstraint)
    other = replace(curved, set=sr.Ellipsoid(centre=[0, 0], shape=[[1.0, 0], [0, 1.0]]))
    x = np.zeros(8)
    gauges = [1.0 + one.worst(x).violations[0] for one in (curved, other)]
    assert gauges[1] == pytest.approx(0.5 * gauges[0], rel=1e-6)


def test_every_constraint_on_the_state_offers_the_same() -> None:
    models = [model_of(name) for name in CASES]
    assert all(isinstance(one, StateConstraint) for model in models for one in model.constraints)
    states = np.array([[0.0, 0.6, 0.4], [0.0, 0.0, 0.4]])
    flat, curved = models[0].constraints[1], models[2].constraints[1]
    np.testing.assert_allclose(flat.excess(states), [-0.5, 0.1, -0.1])
    assert (np.sign(curved.outwardness(states)) == [-1, 1, 1]).all()
    np.testing.assert_allclose(curved.excess(states), [-1.0, 0.2, np.hypot(0.4, 0.4) / 0.5 - 1.0], atol=1e-6)


def test_cuts_of_a_literal_program_are_literal() -> None:
    program = model_of("uncertain", formulation="literal").program
    result = sr.solve(program)
    assert result.status == "certified"
    assert {cut.formulation for cut in result.indices} == {"literal"}
    assert result.worst is not None
    assert result.worst.time is not None


def test_constraints_of_a_result_are_put_in_numbers_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever rounds a bound, derives it, seeks another and writes it down asks for the same ones."""
    model, asked = model_of("flat"), []
    family = model.program.families[0]
    cuts = [Cut(family.name, np.array([time]), row, 1.0) for row, time in ((0, 1.0), (1, 1.5))]
    monkeypatch.setattr(record, "in_numbers", lambda *given: asked.append(given) or object())
    found = model.explained(cuts)
    assert [one is other for one, other in zip(found, model.explained(cuts[::-1])[::-1], strict=True)] == [True, True]
    assert len(asked) == 2
