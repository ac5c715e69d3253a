"""The contract of a problem: its rows, derivatives, separations and enclosures are about one and the same family."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem, ProblemFactory
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.convexity import is_semidefinite
from sparserob_core.sip.program import ConstraintFamily, Explanation, SemiInfiniteProgram
from sparserob_core.testing.contract import Contract, broken, demand, same

if TYPE_CHECKING:
    from sparserob_core.control.policies.policy import Policy
    from sparserob_core.sip.program import Separation

DECISIONS = 4  # decisions at which families are looked at
DRAWN_INDICES = 60  # indices that are drawn
DRAWN_CELLS = 10  # cells that are drawn, with `INDICES_PER_CELL` indices in each
INDICES_PER_CELL = 25  # that are drawn in each of them
DIFFERENCE_STEP = 1e-6  # of the box's side, for differences
DERIVATIVE_ACCURACY = 1e-3  # relative accuracy of a derivative
ROW_ACCURACY = 1e-8  # relative to the terms of a row
SMALL_CELL_SIDE = 1e-7  # cells whose enclosure must be close to the violation: of the side of the box
CLOSES = 1e-3  # how close, relative to the terms of a row
PIECES = 12  # of the dictionaries in which a control problem is looked at
SOLVE_SECONDS = 20.0  # that a solve may take


class ProblemContract(Contract[ProblemFactory], kind="problem"):
    """Contract of a problem: subclass it as ``class TestMine(ProblemContract)`` and give ``component``, with options
    where it needs some (``{"name": "linear", "horizon": ...}``, or a ``functools.partial`` of the class).

    ``build()`` returns an `OptimalControlProblem`, or a `SemiInfiniteProgram` with its families. A control problem is
    transcribed in dictionaries of 12 pieces, and the program is examined family by family. ``rows`` maps indices
    ``(k, d)`` to ``(G (k, r, n), h (k, r))``, and treats each index alike. All other functions of a family (gradient,
    worst, enclosure, cells, nominal, sample, literal, explain) have to agree with its rows.

    ``provable``: whether a decision can be proven; set it to False for a problem that cannot. ``policy``: the knowledge
    of the control, such as an `AffinePolicy`; then rows hold for every deviation, and ``excess`` and ``uncertain`` have
    to agree.
    """

    provable = True
    policy: Policy | None = None

    def built(self) -> OptimalControlProblem | SemiInfiniteProgram:
        """The problem; a broken contract where something else comes back, or something is raised."""
        factory = self.create()
        try:
            problem: object = factory.build()
        except Exception as error:  # noqa: BLE001  a component may raise anything, and must not
            broken(
                f"build raised {type(error).__name__}: {error}",
                "build the problem of the options that the contract is given; `InputError` is for options at fault",
            )
        if not isinstance(problem, OptimalControlProblem | SemiInfiniteProgram):
            broken(
                f"build returned {problem!r}",
                "return a `sparserob_core.OptimalControlProblem` or a `SemiInfiniteProgram`",
            )
        return problem

    def program(self) -> SemiInfiniteProgram:
        """The program, or that of the control problem in dictionaries of 12 pieces."""
        from sparserob_core.control.transcription.transcribe import transcribe

        problem = self.built()
        if isinstance(problem, SemiInfiniteProgram):
            return problem
        pieces = Dictionary(np.linspace(0.0, problem.horizon, PIECES + 1), np.eye(PIECES))
        return transcribe(problem, control=pieces, disturbance=pieces, policy=self.policy)

    def families(self) -> Iterator[tuple[ConstraintFamily, list[Array]]]:
        """Every family, with decisions ``(n,)`` at which it is looked at."""
        program, rng = self.program(), np.random.default_rng(2)
        low = np.where(np.isfinite(program.finite.lower), program.finite.lower, -1.0)
        high = np.where(np.isfinite(program.finite.upper), program.finite.upper, 1.0)
        low, high = (low, high) if program.finite.S is None else (-np.ones(program.n), np.ones(program.n))
        decisions = [low + rng.random(program.n) * (high - low) for _ in range(DECISIONS)]
        for family in program.families:
            yield family, decisions

    def test_it_is_built_the_same_each_time(self) -> None:
        first, second = self.program(), self.program()
        names = ("q", "weights", "lower", "upper", "G", "h", "A", "b")
        changed = [name for name in names if not same(getattr(first.finite, name), getattr(second.finite, name))]
        demand(
            not changed and [family.name for family in first.families] == [family.name for family in second.families],
            f"two builds with the same options differ in {', '.join(changed) or 'their families'}",
            "let nothing but the options decide: no clock, and no random numbers without a seed among the options",
        )
        for family, twin in zip(first.families, second.families, strict=True):
            points = _sample_points(family.index_set, np.random.default_rng(1), DRAWN_INDICES)
            x = np.random.default_rng(2).random(first.n)
            is_same = same(family.violations(x, points), twin.violations(x, points))
            if family.uncertain is None:
                is_same = is_same and all(
                    same(a, b) for a, b in zip(family.rows(points), twin.rows(points), strict=True)
                )
            demand(
                is_same,
                f"two builds with the same options have different rows of {family.name}",
                "let nothing but the options decide",
            )

    def test_its_cost_is_convex(self) -> None:
        P = self.program().finite.P  # a program with another one cannot be made
        demand(
            P is None or is_semidefinite(P),
            "P, made of the quadratic terms of the cost, is not positive semidefinite",
            "shorten the horizon: the rounding of what grows hides the terms that are small",
        )

    def test_rows_have_their_shapes_for_one_index_and_for_many(self) -> None:
        n = self.program().n
        for family, _ in self.families():
            box = family.index_set
            demand(
                np.isfinite(box.lower).all() and np.isfinite(box.upper).all(),
                f"{family.name}: the index set is not bounded",
                "the index set of a family is a bounded box: transform what runs to infinity",
            )
            points = _sample_points(box, np.random.default_rng(3), DRAWN_INDICES)
            if family.uncertain is not None:
                continue
            G, h = _ask_rows(family, points)
            demand(
                G.shape == (len(points), h.shape[-1], n) and h.shape == (len(points), G.shape[1]),
                f"{family.name}: rows returned {G.shape} and {h.shape} for {len(points)} indices of {box.dimension} "
                f"coordinates",
                f"return G of shape (k, r, {n}) and h of shape (k, r) for indices (k, {box.dimension})",
            )
            demand(
                np.isfinite(G).all() and not np.isnan(h).any() and not np.isneginf(h).any(),
                f"{family.name}: rows has numbers that are not finite",
                "look for a division by zero, or a root of a negative number, at the ends of the index set",
            )
            order = np.random.default_rng(4).permutation(len(points))
            single_rows = [_ask_rows(family, points[[k]]) for k in order]
            for k, (G_alone, h_alone) in zip(order, single_rows, strict=True):
                demand(
                    np.allclose(G_alone[0], G[k], rtol=1e-9, atol=1e-12) and np.allclose(h_alone[0], h[k], rtol=1e-9),
                    f"{family.name}: an index has other rows alone than among others",
                    "compute each row from its own index: no mean, maximum or order over the batch",
                )

    def test_rows_that_hold_for_every_deviation_are_violated_by_what_the_family_says(self) -> None:
        spread = self.program().spread
        for family, decisions in self.families():
            if family.uncertain is None:
                continue
            demand(
                spread is not None,
                f"{family.name}: its rows hold for every deviation, and the program has no spread",
                "give the program the `Spread` of its deviations",
            )
            assert spread is not None
            for x in decisions:
                points = _sample_points(family.index_set, np.random.default_rng(13), 8)
                violations = _ask_family(family, "excess", lambda f=family, x=x, p=points: f.violations(x, p))
                for point, batch_violation in zip(points, violations, strict=True):
                    violation = family.violations(x, point[None])[0]
                    rows = _ask_family(family, "uncertain", lambda f=family, p=point: f.uncertain(p))
                    excess, size = rows.excess(x, spread), _measure_size(family, x, point[None])
                    demand(
                        excess.shape == violation.shape
                        and np.abs(excess - violation).max(initial=0.0) <= ROW_ACCURACY * size,
                        f"{family.name}: the rows are violated by {excess[:3]} at {point}, and excess says "
                        f"{violation[:3]}",
                        "`excess` is the violation of the rows of `uncertain` at the worst deviation of the spread",
                    )
                    demand(
                        np.allclose(violation, batch_violation, rtol=1e-9, atol=1e-12 * size),
                        f"{family.name}: an index has another violation alone than among others",
                        "compute each violation from its own index: no mean, maximum or order over the batch",
                    )

    def test_a_gradient_is_the_derivative_of_its_row(self) -> None:
        for family, decisions in self.families():
            if family.gradient is None:
                continue
            box, rng = family.index_set, np.random.default_rng(5)
            points = _sample_points(box, rng, DRAWN_INDICES, margin=0.01)
            for x in decisions:
                rows = rng.integers(0, _ask_rows(family, points)[1].shape[1], len(points))
                gradients = _ask_family(family, "gradient", lambda f=family, x=x, p=points, r=rows: f.gradient(x, p, r))
                wrong = _find_wrong_slopes(family, x, points, rows, np.asarray(gradients))
                demand(
                    wrong.mean() <= 0.1,
                    f"{family.name}: at {wrong.mean():.0%} of the indices the gradient is not the derivative of "
                    "`row x - rhs` in the index",
                    "differentiate the violation of the row that is asked for; mind the sign of the right-hand side",
                )

    def test_a_separation_names_what_is_violated_most(self) -> None:
        for family, decisions in self.families():
            if family.worst is None:
                continue
            points = _sample_points(family.index_set, np.random.default_rng(6), 50 * DRAWN_INDICES)
            for x in decisions:
                separation = _ask_family(family, "worst", lambda f=family, x=x: f.worst(x))
                size = _measure_size(family, x, points)
                self._check_separation(family, x, separation, size)
                sampled = float(family.violations(x, points).max())
                demand(
                    sampled <= separation.bound + ROW_ACCURACY * size,
                    f"{family.name}: worst says that no violation is above {separation.bound:.9g}, and one "
                    f"is {sampled:.9g}",
                    "`bound` holds for the whole index set; give inf where none is proven",
                )
                top = float(separation.violations.max(initial=-np.inf))
                demand(
                    sampled <= top + ROW_ACCURACY * size,
                    f"{family.name}: worst finds at most {top:.9g}, and a drawn index has {sampled:.9g}",
                    "name the most violated index of the whole set; leave `worst` out where it is not known exactly",
                )

    def _check_separation(self, family: ConstraintFamily, x: Array, found: Separation, size: float) -> None:
        box, count = family.index_set, len(found.violations)
        demand(
            found.indices.shape == (count, box.dimension) and found.rows.shape == (count,),
            f"{family.name}: worst has indices {found.indices.shape}, rows {found.rows.shape} and {count} violations",
            f"one index of {box.dimension} coordinates and one row for each violation",
        )
        tolerance = 1e-9 * (box.upper - box.lower)
        demand(
            (found.indices >= box.lower - tolerance).all() and (found.indices <= box.upper + tolerance).all(),
            f"{family.name}: worst names an index outside of the index set",
            "clip the indices to `index_set`",
        )
        violations = family.violations(x, found.indices)[np.arange(count), found.rows] if count else np.zeros(0)
        demand(
            np.abs(violations - found.violations).max(initial=0.0) <= ROW_ACCURACY * size,
            f"{family.name}: worst says {found.violations[:3]} where the rows say {violations[:3]}",
            "a violation is `row x - rhs` at the index and row that are named with it",
        )
        demand(
            (np.diff(found.violations) <= ROW_ACCURACY * size).all(),
            f"{family.name}: worst does not begin with the most violated constraint",
            "sort by falling violation",
        )

    def test_an_enclosure_is_never_below_the_violation_and_closes(self) -> None:
        for family, decisions in self.families():
            if family.enclosure is None:
                continue
            box, rng = family.index_set, np.random.default_rng(7)
            for x in decisions[:2]:
                for share in (1.0, 0.2, 0.01, SMALL_CELL_SIDE):
                    lower, upper = _sample_cells(family, rng, share)
                    enclosure = _ask_family(
                        family, "enclosure", lambda f=family, x=x, a=lower, b=upper: f.enclosure(x, a, b)
                    )
                    samples = (
                        lower[:, None]
                        + rng.random((len(lower), INDICES_PER_CELL, box.dimension)) * (upper - lower)[:, None]
                    )
                    violations = family.violations(x, samples.reshape(-1, box.dimension))
                    largest = violations.reshape(len(lower), INDICES_PER_CELL, -1).max(axis=(1, 2))
                    size = _measure_size(family, x, samples.reshape(-1, box.dimension))
                    demand(
                        np.shape(enclosure.bounds) == np.shape(enclosure.split) == (len(lower),),
                        f"{family.name}: enclosure has bounds {np.shape(enclosure.bounds)} and split "
                        f"{np.shape(enclosure.split)} for {len(lower)} cells",
                        "one bound and one coordinate for each cell",
                    )
                    # Below 0 the scale of a row is its own affair: rows of a curved set are those of directions.
                    below = float((largest - np.maximum(enclosure.bounds, 0.0)).max())
                    demand(
                        below <= ROW_ACCURACY * size,
                        f"{family.name}: an enclosure is {below:.3g} below a violation in "
                        "its cell: what it proves is not true",
                        "bound every term of the row over the whole cell: the least of what is subtracted, the most of "
                        "what is added",
                    )
                    split = np.asarray(enclosure.split)
                    demand(
                        (split >= 0).all() and (split < max(1, box.dimension)).all() and split.dtype.kind in "iu",
                        f"{family.name}: enclosure wants coordinate {split.max()} of {box.dimension} to be halved",
                        "name coordinates from 0, as whole numbers",
                    )
                    if share == SMALL_CELL_SIDE and self.provable:
                        gap = float((enclosure.bounds - largest).max())
                        demand(
                            gap <= CLOSES * size,
                            f"{family.name}: on cells of {SMALL_CELL_SIDE:g} of the index set the enclosure is still "
                            f"{gap:.3g} above the violation: no proof comes to its end",
                            "the bound has to approach the violation as the cell shrinks; see that `cells` begin where "
                            "a row has a jump or a kink, or set `provable = False`",
                        )

    def test_cells_cover_the_index_set_once(self) -> None:
        for family, _ in self.families():
            if family.cells is None:
                continue
            lower, upper = family.cells
            box = family.index_set
            moves = box.lower < box.upper
            sides = np.asarray(upper - lower)[:, moves] / (box.upper - box.lower)[moves]
            demand(
                (upper >= lower).all() and (lower >= box.lower - 1e-12).all() and (upper <= box.upper + 1e-12).all(),
                f"{family.name}: a cell leaves the index set, or its ends are exchanged",
                "`cells` are the lower and upper corners (k, d) of boxes inside of `index_set`",
            )
            if not sides.prod(axis=1).any():
                continue  # directions: the faces of a cube, of which every inner point is a multiple of another
            volume = float(sides.prod(axis=1).sum())
            demand(
                abs(volume - 1.0) <= 1e-6,
                f"{family.name}: the cells fill {volume:.6g} of the index set",
                "cells cover the index set without a gap, and do not overlap but at their sides",
            )
            points = _sample_points(box, np.random.default_rng(8), DRAWN_INDICES)
            inside = np.all((points[:, None] >= lower) & (points[:, None] <= upper), axis=2)
            demand(
                np.any(inside, axis=1).all(),
                f"{family.name}: an index is in no cell",
                "cells cover the index set without a gap",
            )

    def test_other_forms_of_a_family_ask_for_no_more_than_it_does(self) -> None:
        for family, decisions in self.families():
            if family.worst is None or family.uncertain is not None:  # whose literal form has no rows of a decision
                continue
            forms = {"nominal": family.nominal, "literal": family.literal}
            if family.sample is not None:
                with suppress(InputError):
                    forms["sampled"] = family.sample(DRAWN_INDICES, np.random.default_rng(9))
            for name, form in forms.items():
                if form is None:
                    continue
                points = _sample_points(form.index_set, np.random.default_rng(10), DRAWN_INDICES)
                for x in decisions:
                    bound, drawn = family.worst(x).bound, float(form.violations(x, points).max())
                    demand(
                        drawn <= bound + ROW_ACCURACY * _measure_size(form, x, points),
                        f"{family.name}: its {name} form has a violation of {drawn:.9g}, the family itself at most "
                        f"{bound:.9g}",
                        "the nominal, the sampled and the literal form have some of the constraints, and no others",
                    )

    def test_a_constraint_is_explained_in_words(self) -> None:
        for family, _ in self.families():
            points = _sample_points(family.index_set, np.random.default_rng(11), 5)
            for point in points:
                explanation = _ask_family(family, "explain", lambda f=family, p=point: f.explanation(p, 0))
                demand(
                    isinstance(explanation, Explanation) and bool(explanation.text.strip()),
                    f"{family.name}: a constraint is explained by {explanation!r}",
                    "return an `Explanation` whose text says what the constraint asks for, or leave `explain` out",
                )

    def test_a_decision_can_be_proven(self) -> None:
        from sparserob_core.control.transcription.provable import unprovable

        problem = self.built()
        reason = unprovable(problem) if isinstance(problem, OptimalControlProblem) else None
        open_families = [
            family.name for family, _ in self.families() if family.enclosure is None and family.reduced is None
        ]
        demand(
            not self.provable or (reason is None and not open_families),
            f"nothing can be certified: {reason or f'{open_families} has no enclosure'}",
            "write A, B and E as arithmetic of numpy functions of p, give families an `enclosure`, or set "
            "`provable = False` here and tell your users",
        )

    def test_it_is_solved_or_says_why_not(self) -> None:
        from sparserob_core.experiment.run.solve import solve

        problem = self.built()
        control = {"name": "piecewise_constant", "pieces": PIECES}
        options: dict[str, Any] = {}
        if isinstance(problem, OptimalControlProblem):
            options = {"control": control} | ({} if self.policy is None else {"policy": self.policy})
        try:
            result = solve(problem, seconds=SOLVE_SECONDS, **options)
        except InputError as error:
            broken(f"the exchange method refuses it: {error}", "see what the message says of the problem")
        demand(
            result.status != "failed",
            f"the exchange method fails: {result.message}",
            "state the problem in units in which its numbers are of ordinary size",
        )
        demand(
            result.status not in ("refuted", "undecided") or result.stopped or not self.provable,
            f"the exchange method ends with {result.status}: {result.message}",
            "rows and enclosure, or rows and `worst`, may not be about the same constraint",
        )


def _sample_points(box: Box, rng: np.random.Generator, count: int, margin: float = 0.0) -> Array:
    """Indices ``(count, d)`` in a box, its corners among them where no margin is asked for."""
    sides = box.upper - box.lower
    points = box.lower + (margin + (1.0 - 2.0 * margin) * rng.random((count, box.dimension))) * sides
    if not margin and count >= 2:
        points[0], points[1] = box.lower, box.upper
    return np.asarray(points)


def _ask_family(family: ConstraintFamily, what: str, call: Any) -> Any:
    try:
        return call()
    except Exception as error:  # noqa: BLE001  a component may raise anything, and must not
        broken(
            f"{family.name}: {what} raised {type(error).__name__}: {error}",
            f"`{what}` answers for every decision (n,), and for any number of indices or cells (k, d) in the index set",
        )


def _ask_rows(family: ConstraintFamily, points: Array) -> tuple[Array, Array]:
    G, h = _ask_family(family, "rows", lambda: family.rows(points))
    G, h = np.asarray(G, dtype=float), np.asarray(h, dtype=float)
    demand(
        G.ndim == 3 and h.ndim == 2,
        f"{family.name}: rows returned {G.shape} and {h.shape} for {len(points)} indices",
        "return G of shape (k, r, n) and h of shape (k, r) for indices (k, d), with r = 1 for a single row",
    )
    return G, h


def _measure_size(family: ConstraintFamily, x: Array, points: Array) -> float:
    """The largest sum of the terms of a row; of one that holds for every deviation, of its nominal ones and what these
    make of it."""
    if family.uncertain is not None:
        sample = points[:: 1 + len(points) // 8]
        rows = [family.uncertain(point) for point in sample]
        sums = [float((abs(row.g) @ np.abs(x) + np.abs(row.h)).max(initial=0.0)) for row in rows]
        return max(*sums, 0.0, float(np.abs(family.violations(x, sample)).max(initial=0.0))) or 1.0
    G, h = family.rows(points)
    terms = np.abs(G) @ np.abs(x) + np.where(np.isfinite(h), np.abs(h), 0.0)
    return float(terms.max(initial=0.0)) or 1.0


def _sample_cells(family: ConstraintFamily, rng: np.random.Generator, share: float) -> tuple[Array, Array]:
    """Cells whose sides are a share of those of the family's own cells, or of its index set."""
    box = family.index_set
    lower, upper = (box.lower[None], box.upper[None]) if family.cells is None else family.cells
    cells = rng.integers(0, len(lower), DRAWN_CELLS)
    low, sides = lower[cells], (upper - lower)[cells]
    first = low + rng.random(low.shape) * (1.0 - share) * sides
    return first, np.minimum(first + share * sides, low + sides)


def _find_wrong_slopes(family: ConstraintFamily, x: Array, points: Array, rows: np.ndarray, told: Array) -> np.ndarray:
    """Return a mask ``(k,)`` of the indices at which ``told (k, d)`` is no derivative of the row.

    A derivative must equal one of the two one-sided differences, as a row may have kinks.
    """
    box, k = family.index_set, np.arange(len(points))
    sides = box.upper - box.lower
    size, is_wrong = _measure_size(family, x, points), np.zeros(len(points), dtype=bool)
    demand(
        told.shape == points.shape,
        f"{family.name}: gradient returned the shape {told.shape} for {len(points)} indices",
        "return one derivative for each coordinate of each index",
    )
    values = family.violations(x, points)[k, rows]
    for i in np.flatnonzero(sides > 0.0):
        ahead, behind = points.copy(), points.copy()
        ahead[:, i] += DIFFERENCE_STEP * sides[i]
        behind[:, i] -= DIFFERENCE_STEP * sides[i]
        slopes = [
            (family.violations(x, ahead)[k, rows] - values) / DIFFERENCE_STEP,
            (values - family.violations(x, behind)[k, rows]) / DIFFERENCE_STEP,
        ]
        errors = np.min([np.abs(told[:, i] * sides[i] - slope) for slope in slopes], axis=0)
        largest = np.max(np.abs(slopes), axis=0)
        is_wrong |= errors > DERIVATIVE_ACCURACY * (largest + np.abs(told[:, i] * sides[i])) + 1e-6 * size
    return is_wrong
