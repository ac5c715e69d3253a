"""Questions of an observer about the run that it watches, answered from objects of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, final

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.experiment.assemble import Experiment, assemble, tools_of
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.events import DECIDING
from sparserob_core.sip.methods.baselines import Scenario
from sparserob_core.sip.methods.own_units import UsersUnits
from sparserob_core.sip.program import TOLERANCE

if TYPE_CHECKING:
    from sparserob_core.control.problem.problem import OptimalControlProblem
    from sparserob_core.experiment.config.load import Loaded
    from sparserob_core.experiment.figures.clash import Strip
    from sparserob_core.experiment.figures.figure_data import FigureData
    from sparserob_core.sip.evidence import Cut
    from sparserob_core.sip.method import Method
    from sparserob_core.sip.program import ConstraintFamily, SemiInfiniteProgram
    from sparserob_core.sip.result import Result

MAX_ROW_NUMBERS_KEPT = 2**22
"""Numbers of rows that are kept for a map, by family, 32 MiB. With a tenth the rows of its lines are built again and
again where the horizon has a thousand pieces; with ten times as many, watching takes the memory of another run."""
CoordinateKind: TypeAlias = Literal["time", "parameter", "disturbance", "direction", "index"]
LETTERS: Mapping[str, str] = {
    "time": "t",
    "disturbance": "w",
    "direction": "z",
    "index": "xi",
}


@final
@dataclass(frozen=True, eq=False)
class RelaxedValue:
    """The function ``g`` of tuples of indices: the value of the relaxed program that imposes their constraints.

    Parameters
    ----------
    at : callable
        The value at the tuple ``slots (D, width)``; ``+inf`` where the relaxed program is infeasible. NaN in place of
        every coefficient of a disturbance stands for the worst disturbance of each constraint.
    weights : callable
        The multipliers ``(D,)`` of the constraints at every index in the last evaluation.
    gradient : callable
        The slopes ``(D, width)`` of ``g`` in the last evaluation, as far as it has some (`TupleValue.gradient`).
    deciding : callable
        The indices ``(4,)`` with the largest multipliers (`TupleValue.deciding`).
    slot : Box
        The box ``(width,)`` of one index.
    names, kinds : tuple
        The names and the kinds of the coordinates of an index (`Inspection.names`, `Inspection.kinds`).
    interchangeable : bool, default True
        Whether every index is imposed in the same way as every other one, so that two close indices have the same
        effect. The indices of a policy have a deviation each.
    optimum : callable
        The decision ``(n,)`` of the last evaluation with the constraints that have its multipliers; ``None`` where
        there is none.
    """

    at: Callable[[Array], float]
    weights: Callable[[], Array]
    gradient: Callable[[], Array]
    deciding: Callable[[], np.ndarray]
    slot: Box
    names: tuple[str, ...]
    kinds: tuple[CoordinateKind, ...]
    interchangeable: bool = True
    optimum: Callable[[], tuple[Array, tuple[Cut, ...]] | None] = lambda: None

    @property
    def coordinates(self) -> tuple[int, ...]:
        """The coordinates of an index that can move and belong to no disturbance, such as its time."""
        moves = self.slot.upper > self.slot.lower
        return tuple(k for k, kind in enumerate(self.kinds) if moves[k] and kind != "disturbance")


@final
class Inspection:
    """Answers to questions about an experiment, each from a program that was built anew.

    A question therefore cannot change the method. Nothing is built before the first question.
    """

    def __init__(self, loaded: Loaded, experiment: Experiment | None = None) -> None:
        """Keep the config, and the ``experiment`` where it is built already and no method works on it."""
        self._loaded, self._given_experiment = loaded, experiment

    @staticmethod
    def read(directory: Path) -> Inspection:
        """Return the inspection of a run directory, finished or not; raises `InputError` when it is none."""
        from sparserob_core.experiment.directory.finished import read_config

        return Inspection(read_config(directory))

    @property
    def config(self) -> Mapping[str, Any]:
        """The resolved config, as mappings, lists, numbers and text."""
        return self._loaded.config.plain()

    @property
    def program(self) -> SemiInfiniteProgram:
        """The semi-infinite program."""
        return self._experiment.program

    @property
    def problem(self) -> OptimalControlProblem | None:
        """The control problem; ``None`` for a program of another kind."""
        return self._experiment.problem

    @property
    def literal(self) -> bool:
        """True where an index of the method's tuples contains the coefficients of the disturbance."""
        return self.searches and self._loaded.config.method.options.get("formulation") == "literal"

    @cached_property
    def searches(self) -> bool:
        """True where the method maximises ``g`` over tuples of indices."""
        method = self._loaded.config.method
        built: Method = self._loaded.registry.build("method", method.name, method.options)
        return bool(built.searches)

    def picture(self, decision: Array, cuts: Sequence[Cut] = (), draws: int = 0) -> FigureData:
        """Return the data of a figure at a decision: control, nominal states, worst-case tube and walls.

        Parameters
        ----------
        decision : array (m N,)
            The coefficients of the control.
        cuts : sequence of Cut, default ()
            Constraints whose active times and states are marked.
        draws : int, default 0
            Under feedback the number of random disturbances for which the effort is computed.

        Returns
        -------
        FigureData
            The data; under feedback also the effort, and the signals that move the control in the worst case.

        Raises
        ------
        InputError
            If the program is no control problem.
        """
        from sparserob_core.experiment.figures.active import marks_of
        from sparserob_core.experiment.figures.drawing import figure_data

        experiment, theta = self._experiment, np.asarray(decision, dtype=float)
        active = None if experiment.model is None else marks_of(experiment.model, cuts)
        return figure_data(experiment, theta, active, (), None, draws)

    def clash(self, result: Result) -> list[Strip]:
        """Return the quantities of an infeasible result that cannot satisfy their constraints together.

        Each has the allowed range, the range to which the control can bring it, and the effect of the disturbance on
        that. The list is empty for a program that is no control problem, and for a result that is not infeasible.
        """
        from sparserob_core.experiment.figures.clash import clash_strips

        infeasible = self.problem is not None and result.status == "infeasible"
        return clash_strips(self.program, result) if infeasible else []

    def tolerance(self, family: str, row: int = 0) -> float:
        """Return the largest violation of a row that counts as none, in the user's units (decision 16).

        Parameters
        ----------
        family : str
            The name of the constraint family.
        row : int, default 0
            The row of the family.

        Returns
        -------
        float
            The violation.
        """
        own = self.program.own_units
        program = self.program if own is None else own.program
        return TOLERANCE * program.family(family).row_unit(row)

    def row(self, cut: Cut) -> Array | None:
        """Return the left-hand side ``(n,)`` of a constraint that the method has imposed.

        It is that at the sample of a sampled constraint, and at the deviation of a policy's constraint; ``None`` where
        the cut does not contain its deviation.
        """
        family, index = self.program.family(cut.family), np.asarray(cut.index, dtype=float)
        if family.uncertain is not None:
            size = family.index_set.dimension
            if index.size == size:
                return None
            rows = family.uncertain(index[:size])
            group, factor = int(rows.part[cut.row]), float(rows.factor[cut.row])
            return np.asarray(rows.g[[cut.row]].toarray()[0] + factor * (index[size:] @ rows.C[group]))
        imposed = (
            self._scenario_families.get(cut.family)
            if cut.formulation == "sampled"
            else family.formulated(cut.formulation)
        )
        return None if imposed is None else imposed.rows(index[np.newaxis])[0][0, cut.row]

    @cached_property
    def _scenario_families(self) -> Mapping[str, ConstraintFamily]:
        """The constraint families of the method ``scenario`` by name, at its own samples."""
        method = self._loaded.config.method
        built: Method = self._loaded.registry.build("method", method.name, method.options)
        if not isinstance(built, Scenario):
            return {}
        families = built.simplified(self.program, np.random.default_rng(self._loaded.config.seed)).families
        return {family.name: family for family in families}

    def worst_cases(self, decision: Array) -> dict[str, Array]:
        """Return the worst parameter and disturbance of every state constraint at a decision, and the states that they
        cause.

        The arrays are those of ``adversary.npz``: ``names (f,)``, ``violations (f,)``, ``times (f,)``, ``state_times
        (T,)``, ``states (f, d, T)``, and so on. The mapping is empty where there is no such constraint.
        """
        from sparserob_core.experiment.directory.adversary import adversaries

        return adversaries(self._experiment, decision)

    def relaxed_value(self, count: int, epsilon: float) -> RelaxedValue:
        """Return the function ``g(epsilon; .)`` of tuples of indices in the method's formulation, from a relaxed
        program of its own.

        Parameters
        ----------
        count : int
            The number of indices of a tuple.
        epsilon : float
            The weight of the regulariser.

        Returns
        -------
        RelaxedValue
            The function. For a policy the indices are literal, ``(t, w)`` with a deviation ``w``, and ``epsilon`` is 0.

        Raises
        ------
        InputError
            If the program has no constraint family.
        """
        from sparserob_core.sip.relaxed.relaxed import RelaxedProgram
        from sparserob_core.sip.relaxed.tuples import TupleValue, imposed_program
        from sparserob_core.sip.solver import quickest

        if self.program.spread is not None:
            return self._build_policy_value()
        formulation: Literal["literal", "reduced"] = "literal" if self.literal else "reduced"
        users, tools = imposed_program(self.program, formulation), tools_of(self._loaded)
        if not users.families:
            raise InputError("families: expected at least one constraint family, got none")
        # in the units in which methods solve: the weight epsilon is in the program's own units (decision 16)
        own = self.program.own_units
        program = users if own is None else imposed_program(own.program, formulation)
        if self.literal:
            is_disturbance = np.array([kind == "disturbance" for kind in self.kinds(self.width)])
            program = replace(
                program, families=[_substitute_worst(family, is_disturbance) for family in program.families]
            )
        program = replace(program, families=[_remember_rows(family) for family in program.families])
        value = TupleValue(program, RelaxedProgram(program, quickest(tools.solver), tools.regulariser), count)
        value.epsilon = epsilon if tools.regulariser is not None and np.isfinite(epsilon) else 0.0
        width, cost = value.layout.slot.dimension, 1.0 if own is None else own.cost
        units = np.ones(width) if own is None else UsersUnits(own).tuple_units(width, width)
        per_index = sum(family.rows(family.index_set.lower[np.newaxis])[1].shape[1] for family in program.families)

        def weights() -> Array:
            return np.bincount(value.imposed.positions // per_index, value.imposed.multipliers, count).astype(float)

        def gradient() -> Array:
            return cost * value.gradient(value.slots.ravel()).reshape(value.slots.shape) / units

        def optimum() -> tuple[Array, tuple[Cut, ...]] | None:
            decision = value.solution.x
            if value.solution.status != "optimal" or not np.isfinite(decision).all():
                return None
            cuts = value.rows().cuts
            return (decision, cuts) if own is None else (decision * own.decision, UsersUnits(own).cuts(cuts))

        slot = value.layout.slot
        return RelaxedValue(
            lambda slots: cost * value.at(np.ravel(np.clip(slots / units, slot.lower, slot.upper))),
            weights,
            gradient,
            lambda: value.deciding([value.imposed], DECIDING)[0],
            Box(slot.lower * units, slot.upper * units),
            self.names(width),
            self.kinds(width),
            optimum=optimum,
        )

    def _build_policy_value(self) -> RelaxedValue:
        from sparserob_core.sip.relaxed.policy_value import PolicyValue

        assert self.program.spread is not None
        # in the units in which methods solve, the program's own (decision 16)
        own = self.program.own_units
        program = self.program if own is None else own.program
        value, deviations = PolicyValue(program), self.program.spread.size
        width, cost = 1 + deviations, 1.0 if own is None else own.cost
        units = np.ones(width) if own is None else UsersUnits(own).tuple_units(width, width)
        times = [family.index_set for family in self.program.families if not family.defines]
        lower, upper = min(float(box.lower[0]) for box in times), max(float(box.upper[0]) for box in times)
        kinds: tuple[CoordinateKind, ...] = ("time", *_repeat_kind("disturbance", deviations))
        radii = np.full(deviations, 1.0 / TOLERANCE)  # no coefficient of a deviation is an axis: any large box will do

        def deciding() -> np.ndarray:
            weights = value.weights()
            order = np.argsort(-weights, kind="stable")[:DECIDING]
            return np.where(weights[order] > 0.0, order, -1)

        return RelaxedValue(
            lambda slots: cost * value.at(slots / units),
            value.weights,
            lambda: np.zeros((value.weights().size, width)),
            deciding,
            Box(np.concatenate([[lower], -radii]), np.concatenate([[upper], radii])),
            ("t", *(f"w{k + 1}" for k in range(deviations))),
            kinds,
            interchangeable=False,
        )

    @property
    def width(self) -> int:
        """The number of coordinates of one index of the method's tuples."""
        from sparserob_core.sip.relaxed.tuples import TupleLayout, imposed_program

        program = imposed_program(self.program, "literal" if self.literal else "reduced")
        return TupleLayout(program.families, 1).slot.dimension

    def names(self, width: int) -> tuple[str, ...]:
        """Return the names of the ``width`` coordinates of one index.

        They are ``t``, ``w1``, ... (coefficients of the disturbance), the parameters as in the config, and ``z1``, ...
        (a direction). They are ``xi1``, ... where there is no control problem.
        """
        kinds, problem = self.kinds(width), self.problem
        parameter_names = iter(() if problem is None else problem.system.names)
        return tuple(
            next(parameter_names)
            if kind == "parameter"
            else LETTERS[kind] + ("" if kind == "time" else str(kinds[: k + 1].count(kind)))
            for k, kind in enumerate(kinds)
        )

    def kinds(self, width: int) -> tuple[CoordinateKind, ...]:
        """Return the kinds of the ``width`` coordinates of one index; ``index`` where there is no control problem."""
        problem = self.problem
        if problem is None:
            return tuple(_repeat_kind("index", width))
        parameters = _repeat_kind("parameter", problem.system.parameter_count)
        count = width - 1 - len(parameters)
        if self.literal:  # in the order of LiteralConstraint: time, coefficients, then the rest of the reduced index
            return ("time", *_repeat_kind("disturbance", count), *parameters)
        return ("time", *parameters, *_repeat_kind("direction", count))

    @cached_property
    def _experiment(self) -> Experiment:
        return self._given_experiment or assemble(self._loaded)


def _substitute_worst(family: ConstraintFamily, coefficients: np.ndarray) -> ConstraintFamily:
    """Return a literal family in which NaN in place of all ``coefficients (width,)`` of a disturbance means the worst
    one.

    The rows are then the reduced ones, at the other coordinates of the index.
    """
    reduced, literal, is_coefficient = family.reduced, family.rows, coefficients[: family.index_set.dimension]
    if reduced is None:  # no uncertainty acts on it
        return family

    def rows(indices: Array) -> tuple[Array, Array]:
        at_worst = np.isnan(indices[:, is_coefficient]).any(axis=1)
        if not at_worst.any():
            return literal(indices)
        G, h = reduced.rows(indices[:, ~is_coefficient])
        if not at_worst.all():
            G[~at_worst], h[~at_worst] = literal(indices[~at_worst])
        return G, h

    return replace(family, rows=rows)


def _remember_rows(family: ConstraintFamily) -> ConstraintFamily:
    """Return a family that keeps up to `MAX_ROW_NUMBERS_KEPT` numbers of its rows: the indices of a map lie on a few
    lines."""
    build, by_index = family.rows, dict[bytes, tuple[Array, Array]]()

    def rows(indices: Array) -> tuple[Array, Array]:
        keys = [index.tobytes() for index in indices]
        size = next(iter(by_index.values()))[0].size if by_index else 0
        if (len(by_index) + len(keys)) * size > MAX_ROW_NUMBERS_KEPT:
            by_index.clear()
        places = {key: k for k, key in enumerate(keys) if key not in by_index}
        if places:
            G, h = build(indices[list(places.values())])
            by_index.update({key: (G[k].copy(), h[k].copy()) for k, key in enumerate(places)})
        return np.array([by_index[key][0] for key in keys]), np.array([by_index[key][1] for key in keys])

    return replace(family, rows=rows)


def _repeat_kind(kind: CoordinateKind, count: int) -> list[CoordinateKind]:
    return [kind] * count
