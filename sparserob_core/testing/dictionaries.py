"""The contract of a dictionary: independent functions on the whole horizon, whatever it is, in numbers of ordinary
size."""

from __future__ import annotations

import numpy as np

from sparserob_core.control.problem.dictionary import Dictionary, DictionaryFactory
from sparserob_core.errors import InputError
from sparserob_core.testing.contract import Contract, broken, demand, same

HORIZONS = (1.0, 0.3, 2.5, 1 / 3, 1e-3, 5400.0, 1.0)
CONDITION = 1e10  # of the Gram matrix of the functions, each of norm 1
SIZES = (1e-6, 1e6)  # of the largest value of a function
SHORTEST_PIECE = 1e-9  # piece, as a share of the horizon
DICTIONARY_PIECES = 20_000  # pieces


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
