"""Guards sip/working/unbounded: programs with free variables get the rows that bound them, the dear way only where the
cheap one does not do."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.evidence import Cut, Dual
from sparserob_core.sip.inner.duality import balance_rows
from sparserob_core.sip.relaxed.relaxed import rows_of
from sparserob_core.sip.working import unbounded
from tests.support.oscillating import PROGRAMS


def test_a_few_rows_of_every_family_bound_a_filter_so_that_no_direction_is_looked_for(monkeypatch):
    def dear(*arguments):
        raise AssertionError("a recession program was solved")

    monkeypatch.setattr(unbounded, "bounding_rows", dear)
    result = sr.solve(PROGRAMS["filter, half"]())
    assert abs(result.cost - 0.0087149597) <= 1e-8
    assert abs(result.cost - result.lower_bound) <= 1e-8


def test_the_first_rows_are_twice_as_many_as_the_variables_in_every_family():
    def rows(t):
        return np.ones((len(t), 2, 7)), np.ones((len(t), 2))

    families = [
        sr.ConstraintFamily(name="line", index_set=sr.Box([-1.0], [3.0]), rows=rows),
        sr.ConstraintFamily(name="plane", index_set=sr.Box([0.0, 5.0, 1.0], [1.0, 5.0, 2.0]), rows=rows),
        sr.ConstraintFamily(name="point", index_set=sr.Box([2.0], [2.0]), rows=rows),
    ]
    line, plane, point = unbounded.first_rows(sr.SemiInfiniteProgram(n=7, families=families))
    assert [name for _, _, name in (line, plane, point)] == ["line", "plane", "point"]
    assert len(np.unique(line[0])) == unbounded.ROWS_PER_VARIABLE * 8
    assert {-1.0, 3.0} <= set(line[0][:, 0])
    assert len(np.unique(plane[0], axis=0)) == 16
    assert (plane[0][:, 1] == 5.0).all()
    assert point[0].tolist() == [[2.0], [2.0]]
    assert all(np.bincount(rows).tolist() == [len(rows) // 2] * 2 for _, rows, _ in (line, plane, point))


@pytest.mark.slow
@pytest.mark.parametrize(("strike", "published"), [(30, 21.51), (40, 13.20), (50, 7.30)])
def test_the_price_of_an_option_on_the_largest_of_three_is_bounded_from_its_moments(strike, published):
    """Boyle and Lin (1997): the least mean of a quadratic that is above the payoff; the first rows bound it not."""
    mean, variance, covariance = 44.21, 184.04, 164.88
    square, product = variance + mean**2, covariance + mean**2
    moments = np.array([square, product, product, square, product, square, mean, mean, mean, 1.0])

    def monomials(s):
        x, y, z = s.T
        return np.stack([x * x, x * y, x * z, y * y, y * z, z * z, x, y, z, np.ones_like(x)], axis=-1)

    def above(asset):
        return lambda s: (
            -monomials(s)[:, np.newaxis],
            (np.zeros(len(s)) if asset is None else strike - s[:, asset])[:, np.newaxis],
        )

    families = [
        sr.ConstraintFamily(name=str(asset), index_set=sr.Box([-400.0] * 3, [400.0] * 3), rows=above(asset))
        for asset in (None, 0, 1, 2)
    ]
    result = sr.solve(sr.SemiInfiniteProgram(n=10, q=moments, families=families))
    assert abs(result.cost - published) <= 0.005
    assert abs(result.cost - result.lower_bound) <= 1e-6


def test_first_rows_that_meet_the_zeros_of_a_sine_are_replaced_by_more():
    """Three angles from 0 to a full turn leave the factor of a sine without a row; four leave cosines of one sign."""
    rows = "(exp(x) - a)*cos(q) + (sin(3*x) - b)*sin(q) <= d"
    index = {"x": (-1.0, 1.0), "q": (0.0, 2.0 * np.pi)}
    family = sr.ConstraintFamily.from_expressions("e", index=index, rows=rows, decision=dict.fromkeys("abd"))
    program = sr.SemiInfiniteProgram(n=3, q=[0.0, 0.0, 1.0], families=[family])
    ((indices, _, _),) = unbounded.first_rows(program)
    assert len(indices) == 25
    result = sr.solve(program)
    assert result.status == "certified"
    x = np.linspace(-1.0, 1.0, 2001)
    curve = np.column_stack([np.exp(x), np.sin(3.0 * x)])
    distance = np.linalg.norm(curve - result.decision[:2], axis=1).max()
    assert abs(distance - result.cost) <= 1e-6  # the radius of the smallest circle around the curve
    ends = np.linalg.norm(curve[:, None] - curve[None, ::10], axis=2).max() / 2
    assert result.cost >= ends - 1e-6


def test_rows_that_bound_a_program_have_a_positive_combination_with_its_cost():
    rows, cost = np.array([[1.0, -1.0], [-1.0, -1.0]]), np.array([0.0, 1.0])
    y, _, factor = balance_rows(rows, np.zeros((0, 2)), cost)
    assert (y > 0.0).all()
    assert np.abs(y @ rows + factor * cost).max() <= 1e-9
    assert balance_rows(rows, np.zeros((0, 2)), np.zeros(2)) is None  # the second entry rises for ever
    assert balance_rows(rows[:1], np.zeros((0, 2)), cost) is None
    y, mu, factor = balance_rows(rows[:1], np.array([[1.0, 0.0]]), cost)
    assert np.abs(y @ rows[:1] + mu @ np.array([[1.0, 0.0]]) + factor * cost).max() <= 1e-9


def test_multipliers_of_fewer_rows_than_free_variables_are_joined_by_others_with_the_cost():
    """The largest ``x + 0.3 y`` below one parabola: one row is active, no rows alone cancel, since all of them bound
    ``x`` from one side, and a multiplier that is rounding is none."""
    family = sr.ConstraintFamily.from_expressions(
        "below", index={"t": (-1, 1)}, rows=["x + y*t <= 3 + (t - 0.3)^2"], decision={"x": None, "y": None}
    )
    program = sr.SemiInfiniteProgram(n=2, q=[-1.0, -0.3], families=[family])
    for noise in ((), (Cut("below", np.array([-0.7]), 0, multiplier=1e-15),)):
        dual = Dual(bound=-3.0, cuts=(Cut("below", np.array([0.3]), 0, multiplier=1.0), *noise), mu=np.zeros(0))
        full = unbounded.complete_multipliers(program, dual, True)
        rows = rows_of(program, [(cut.index[None], np.array([cut.row]), cut.family) for cut in full.cuts])
        y = np.array([cut.multiplier for cut in full.cuts])
        assert (y > 0.0).all() and np.linalg.matrix_rank(rows.G[y > 1e-14]) == 2
        assert program.finite.q + y @ rows.G == pytest.approx([0.0, 0.0], abs=3e-15)
        assert -y @ rows.h == pytest.approx(-3.0, rel=1e-11)


def test_three_coordinates_take_few_rounds_and_no_solver_is_asked_for_an_unbounded_program():
    """The option of the test above, as text, with a proof."""
    quadratic = "a[0]*x^2+a[1]*x*y+a[2]*x*z+a[3]*y^2+a[4]*y*z+a[5]*z^2+a[6]*x+a[7]*y+a[8]*z+a[9]"
    family = sr.ConstraintFamily.from_expressions(
        "payoff",
        index=dict.fromkeys("xyz", (-400, 400)),
        rows=[f"{quadratic} >= {payoff}" for payoff in ("0", "x - 40", "y - 40", "z - 40")],
        decision={"a": 10},
    )
    mean, square, product = 44.21, 2138.5641, 2119.4041
    moments = [square, product, product, square, product, square, mean, mean, mean, 1.0]
    result = sr.solve(sr.SemiInfiniteProgram(n=10, q=moments, families=[family]))
    assert result.status == "certified" and result.cost == pytest.approx(13.2036941, rel=1e-7)
    assert result.counts["rounds"] <= 25 and result.counts["solver_calls"] == 0
