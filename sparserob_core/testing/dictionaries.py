"""Contracts of the functions of a control and of their weights.

A dictionary has independent functions on the whole horizon, whatever it is, in numbers of ordinary size. A regulariser
is a strictly convex quadratic of their coefficients, for every dictionary.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_array, eye_array, issparse, kron

from sparserob_core.control.problem.dictionary import Dictionary, DictionaryFactory
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.convexity import ControlImage, Regulariser
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.testing.contract import Contract, broken, demand, same

HORIZONS = (1.0, 0.3, 2.5, 1 / 3, 1e-3, 5400.0, 1.0)
CONDITION = 1e10  # of the Gram matrix of the functions, each of norm 1
SIZES = (1e-6, 1e6)  # of the largest value of a function
SHORTEST_PIECE = 1e-9  # piece, as a share of the horizon
DICTIONARY_PIECES = 20_000  # pieces
CURVATURE = 1e-10  # the smallest eigenvalue of P, as a share of the largest
CURVATURE_SIZES = (1e-9, 1e9)  # of the largest eigenvalue of P
VALUE = 0.4  # of `two_thrusters`


def images() -> list[ControlImage]:
    """Return images of one to three channels, with pieces of equal and of different lengths, and with as many functions
    as pieces or fewer."""
    haar = np.array([[1, 1, 1, 1], [1, 1, -1, -1], [1, -1, 0, 0]], dtype=float)
    uneven = np.array([0.5, 0.1, 0.3, 0.1, 2.0])
    return [
        ControlImage(csc_array(np.eye(1)), 1, np.ones(1)),
        ControlImage(csc_array(np.eye(20)), 1, np.full(20, 0.25)),
        ControlImage(csc_array(np.eye(10)), 2, np.tile(uneven, 2)),
        ControlImage(csc_array(kron(eye_array(2), haar.T)), 2, np.full(8, 0.5)),
        ControlImage(csc_array(kron(eye_array(3), np.ones((4, 1)))), 3, np.full(12, 100.0)),
    ]


def two_thrusters() -> SemiInfiniteProgram:
    """minimise ``|x|_1 / 10`` subject to ``sum x >= 4`` and ``|x| <= 1``, for 20 numbers: 0.4, of many optimisers."""
    return SemiInfiniteProgram(
        n=20, weights=0.1, lower=-1.0, upper=1.0, G=-np.ones((1, 20)), h=np.array([-4.0]), lengths=np.full(20, 0.1)
    )


class RegulariserContract(Contract[Regulariser], kind="regulariser"):
    """Contract of a regulariser: subclass it as ``class TestMine(RegulariserContract)`` and give ``component``.

    ``quadratic(image)`` returns ``P (n, n)``, sparse, symmetric and positive definite, and ``q (n,)``, of
    ``rho(x) = 1/2 x'P x + q'x``, where ``n`` is the number of columns of ``image.S``. The image gives the meaning of a
    decision: ``S x`` is the control on each piece, channel by channel, and ``lengths`` are the lengths of the pieces.
    """

    def quadratic(self, regulariser: Regulariser, image: ControlImage) -> tuple[csc_array, Array]:
        """``P`` and ``q``; a broken contract where something else comes back, or something is raised."""
        where = f"an image with {image.channels} channels of {image.pieces} pieces and {image.S.shape[1]} coefficients"
        try:
            answer: object = regulariser.quadratic(image)
        except Exception as error:  # noqa: BLE001  a component may raise anything, and must not
            broken(
                f"quadratic raised {type(error).__name__}: {error} for {where}",
                "take every size from the image: `image.S.shape[1]`, `image.channels`, `image.pieces`",
            )
        if not (isinstance(answer, tuple) and len(answer) == 2):
            broken(f"quadratic returned {type(answer).__name__} for {where}", "return the pair `P, q`")
        P, q = answer[0], np.asarray(answer[1])
        n = image.S.shape[1]
        demand(
            issparse(P) and P.shape == (n, n) and q.shape == (n,),
            f"quadratic returned P of shape {np.shape(P)} ({type(P).__name__}) and q of shape {q.shape} for {where}",
            f"return `scipy.sparse.csc_array` of shape ({n}, {n}) and an array of shape ({n},) there",
        )
        demand(
            np.isfinite(P.data).all() and q.dtype.kind in "fiu" and np.isfinite(q).all(),
            f"quadratic returned numbers that are not finite for {where}",
            "look for a division by a length, or by a difference of two",
        )
        return P, q

    def test_it_is_strictly_convex(self) -> None:
        for image in images():
            dense = self.quadratic(self.create(), image)[0].toarray()
            demand(
                np.abs(dense - dense.T).max() <= 1e-12 * np.abs(dense).max(),
                f"P is not symmetric: it differs from its transpose by {np.abs(dense - dense.T).max():.1e}",
                "return `(P + P.T) / 2`, which is the same quadratic",
            )
            curvature = np.linalg.eigvalsh((dense + dense.T) / 2)
            demand(
                curvature[0] > CURVATURE * max(curvature[-1], 0.0),
                f"P has the eigenvalues {curvature[0]:.3g} to {curvature[-1]:.3g}: it is not positive definite",
                "add a small multiple of the identity: only a strictly convex term makes the optimiser unique",
            )

    def test_it_is_of_ordinary_size(self) -> None:
        for image in images():
            P, q = self.quadratic(self.create(), image)
            size = float(np.linalg.eigvalsh(P.toarray())[-1])
            demand(
                CURVATURE_SIZES[0] <= size <= CURVATURE_SIZES[1] and np.abs(q).max() <= CURVATURE_SIZES[1],
                f"P has the largest eigenvalue {size:.1e}, and q the largest entry {np.abs(q).max():.1e}",
                "the weight of the regulariser is the method's, from `continuation.start` downwards: state the term "
                "itself in the units of the control and of time",
            )

    def test_the_same_image_gives_the_same_term_whatever_came_before(self) -> None:
        regulariser = self.create()
        for image in [*images(), *images()]:
            P, q = self.quadratic(regulariser, image)
            fresh, p = self.quadratic(self.create(), image)
            demand(
                same(P.toarray(), fresh.toarray()) and same(q, p),
                "an old regulariser and a new one give different terms for one image",
                "keep nothing between calls of `quadratic`, and use no random numbers",
            )

    def test_the_image_is_left_as_it_was(self) -> None:
        for image, before in zip(images(), images(), strict=True):
            self.quadratic(self.create(), image)
            demand(
                same(image.S.toarray(), before.S.toarray()) and same(image.lengths, before.lengths),
                "quadratic has written into the image",
                "make a new matrix; `image.S.data` and `image.lengths` are shared",
            )

    def test_every_control_is_regularised(self) -> None:
        for image in images():
            n = image.S.shape[1]
            dense = self.quadratic(self.create(), image)[0].toarray()
            bare = [k for k in range(n) if not dense[k, k] > 0.0]
            demand(
                not bare,
                f"coefficient {bare[0] if bare else ''} of {n} is not regularised",
                "rows of S are channel by channel: repeat weights with `np.repeat(weights, image.pieces)`",
            )

    def test_the_cost_that_is_reached_is_that_without_it(self) -> None:
        from sparserob_core.experiment.run.solve import solve

        result = solve(two_thrusters(), regulariser=self.create())
        demand(
            result.status == "certified" and abs(result.cost - VALUE) <= 1e-6,
            f"with it the exchange method ends with {result.status} and the cost {result.cost:.9g}, where {VALUE} is "
            f"the optimum ({result.message})",
            "see that P and q are of ordinary size: their weight goes to zero, but has to start somewhere",
        )


class DictionaryContract(Contract[DictionaryFactory], kind="dictionary"):
    """Contract of a dictionary: subclass it as ``class TestMine(DictionaryContract)`` and give ``component``.

    ``build(horizon)`` returns a `Dictionary`: ``breakpoints (K + 1,)`` from exactly 0 to exactly the horizon, and
    ``values (N, K)``, ``N <= K`` linearly independent functions on the ``K`` pieces. Nothing else may depend on earlier
    calls. ``horizons`` are the horizons that are tried; a component whose options fit some horizons only needs its own.
    A horizon that the options do not fit is refused with an `InputError`.
    """

    horizons: tuple[float, ...] = HORIZONS

    def built(self, factory: DictionaryFactory, horizon: float) -> Dictionary:
        """A dictionary on the horizon; a broken contract where something else comes back, or something is raised."""
        try:
            dictionary: object = factory.build(horizon)
        except Exception as error:  # noqa: BLE001  a component may raise anything, and must not
            broken(
                f"build({horizon:g}) raised {type(error).__name__}: {error}",
                "build any horizon; where options fit some horizons only, set `horizons` of this contract to those",
            )
        if not isinstance(dictionary, Dictionary):
            broken(f"build({horizon:g}) returned {dictionary!r}", "return a `sparserob_core.Dictionary`")
        return dictionary

    def test_it_covers_the_horizon_from_end_to_end(self) -> None:
        factory = self.create()
        for horizon in self.horizons:
            dictionary = self.built(factory, horizon)
            first, last = float(dictionary.breakpoints[0]), float(dictionary.breakpoints[-1])
            demand(
                first == 0.0 and last == horizon,
                f"build({horizon!r}) covers the times from {first!r} to {last!r}",
                "scale the breakpoints by the horizon, and set the last of them to it: rounding alone may miss it",
            )

    def test_breakpoints_increase_by_lengths_that_count(self) -> None:
        factory = self.create()
        for horizon in self.horizons:
            dictionary = self.built(factory, horizon)
            shortest = float(np.diff(dictionary.breakpoints).min()) / horizon
            demand(
                shortest >= SHORTEST_PIECE,
                f"build({horizon:g}) has a piece of {shortest:.1e} of the horizon",
                f"join pieces shorter than {SHORTEST_PIECE:g} of the horizon with their neighbours: rounding eats them",
            )
            demand(
                1 <= dictionary.values.shape[1] <= DICTIONARY_PIECES
                and dictionary.values.shape[1] == dictionary.breakpoints.size - 1,
                f"build({horizon:g}) has values on {dictionary.values.shape[1]} of "
                f"{dictionary.breakpoints.size - 1} pieces",
                f"values have one column for each piece, of at most {DICTIONARY_PIECES} pieces",
            )

    def test_its_functions_are_linearly_independent(self) -> None:
        factory = self.create()
        for horizon in self.horizons:
            dictionary = self.built(factory, horizon)
            weighted = dictionary.values * np.sqrt(np.diff(dictionary.breakpoints))
            norms = np.linalg.norm(weighted, axis=1)
            demand(
                (norms > 0.0).all(),
                f"build({horizon:g}): function {int(norms.argmin())} is zero",
                "leave out functions that are zero on the whole horizon",
            )
            singular_values = np.linalg.svd(weighted / norms[:, None], compute_uv=False)
            condition = np.inf if singular_values[-1] == 0.0 else float((singular_values[0] / singular_values[-1]) ** 2)
            demand(
                singular_values.size == dictionary.values.shape[0] and condition <= CONDITION,
                f"build({horizon:g}): the functions are linearly dependent, or nearly so (condition {condition:.1e})",
                "leave out functions that others make up; orthogonal ones are safest",
            )

    def test_its_values_are_numbers_of_ordinary_size(self) -> None:
        factory = self.create()
        for horizon in self.horizons:
            sizes = np.abs(self.built(factory, horizon).values).max(axis=1)
            demand(
                np.isfinite(sizes).all() and sizes.min() >= SIZES[0] and sizes.max() <= SIZES[1],
                f"build({horizon:g}): the largest values of the functions lie between {sizes.min():.1e} and "
                f"{sizes.max():.1e}",
                "divide each function by its largest absolute value: coefficients then are of the control's size",
            )

    def test_the_same_horizon_gives_the_same_dictionary_whatever_was_built_before(self) -> None:
        factory = self.create()
        for horizon in self.horizons:
            reused, fresh = self.built(factory, horizon), self.built(self.create(), horizon)
            demand(
                same(reused.breakpoints, fresh.breakpoints) and same(reused.values, fresh.values),
                f"build({horizon:g}) of an old factory and of a new one give different dictionaries",
                "keep nothing between calls of `build`, and use neither clock nor random numbers without a seed option",
            )

    def test_one_dictionary_may_be_changed_without_changing_the_next(self) -> None:
        factory, horizon = self.create(), self.horizons[0]
        before = self.built(factory, horizon)
        values, breakpoints = before.values.copy(), before.breakpoints.copy()
        for array in (before.values, before.breakpoints):
            if array.flags.writeable:
                array[...] = 0.0
        after = self.built(factory, horizon)
        demand(
            same(after.values, values) and same(after.breakpoints, breakpoints),
            "an array of one dictionary is an array of the next one",
            "build new arrays in every call of `build`",
        )

    def test_a_horizon_that_makes_no_sense_is_an_input_error_or_is_built(self) -> None:
        factory = self.create()
        for horizon in (1e-9, 1e9):
            try:
                dictionary: object = factory.build(horizon)
            except InputError:
                continue
            except Exception as error:  # noqa: BLE001  as above
                broken(
                    f"build({horizon:g}) raised {type(error).__name__}: {error}",
                    "raise `sparserob_core.InputError`, with the option and the horizon in its text, where they do "
                    "not fit together",
                )
            demand(
                isinstance(dictionary, Dictionary),
                f"build({horizon:g}) returned {dictionary!r}",
                "return a `Dictionary`",
            )

    def test_a_control_can_be_written_in_it(self) -> None:
        from sparserob_core.control.problem.problem import OptimalControlProblem
        from sparserob_core.control.problem.system import LinearSystem
        from sparserob_core.experiment.run.solve import solve
        from sparserob_core.sip.convex_set import Box

        horizon = self.horizons[0]
        dictionary = self.built(self.create(), horizon)
        problem = OptimalControlProblem(
            system=LinearSystem(np.zeros((1, 1)), np.ones((1, 1))),
            horizon=horizon,
            initial_state=[0.5 * horizon],
            control=Box(-np.ones(1), np.ones(1)),
            terminal=[Box(np.array([-0.3 * horizon]), np.array([0.3 * horizon]))],
        )
        result = solve(problem, control=dictionary)
        demand(
            result.status in ("certified", "infeasible"),
            f"a control of one integrator in this dictionary: {result.status}, {result.message}",
            "the functions may be too much alike, or their values of too different sizes",
        )
        if result.decision is not None:
            area = float(dictionary.control(result.decision)[0] @ dictionary.lengths)
            demand(
                area <= -0.2 * horizon * (1.0 - 1e-6) and abs(result.cost + area) <= 1e-6 * horizon,
                f"the control has the integral {area:.6g} and the cost {result.cost:.6g}, where -0.2 times the horizon "
                "was to be reached at the least cost",
                "the values of the dictionary must be those of its functions on the pieces, one row for each function",
            )
