"""Simulated annealing in a box: cheap moves of one or few coordinates at scales that adapt, and a share of uniform
proposals."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

import sparserob_core as sr
from sparserob_simulated_annealing.cooling import Cooling, first_temperature
from sparserob_simulated_annealing.moves import Moves


class SimulatedAnnealing(sr.Maximiser, sr.Options):
    """A walk that accepts what is worse with a probability that falls with the temperature (Kirkpatrick, Gelatt and
    Vecchi 1983).

    Condition of Belisle (1992, J. Appl. Prob. 29, 885-895) on the candidates: their density is bounded away from 0 on
    the box. It holds at every step, with the bound ``exploration / volume``, because that share of the candidates is
    uniform, whatever the other moves do. For a continuous function, Metropolis' rule, a kernel that does not adapt
    (``adapt: none``) and temperatures that tend to 0 in probability, at any rate, the values of an endless walk then
    tend to the maximum in probability. Of the run that ends: ``n`` evaluations miss a set of a share ``v`` of the
    volume with probability ``(1 - exploration v)^n`` at most, with every option, so the best value tends to the maximum
    almost surely. With ``exploration: 0`` neither is true: one-coordinate moves have no density at all, and scales that
    shrink can leave the walk in one basin for ever.

    In high dimension the guarantee is kept and worthless: ``v`` falls like ``radius^d``, and what is found is what the
    local moves find. They stay cheap: one copy of the point, and random numbers for what changes only. Where
    coordinates come in blocks (tuples of indices), a move changes one coordinate of a block, one block, or two or
    three; only the uniform candidates change every block, so the objective must rebuild every row for that share of the
    budget. A permutation of a tuple is the same value at another point: the walk does not merge them; that does it no
    harm, since every copy of a basin is as good. It proves no upper bound.

    Notes, at every step: ``temperature``, ``accepted`` (0 or 1), ``scale`` (of the step, in widths of the box),
    ``move`` (what was moved: 0 everything anew, 1 one coordinate, 2 several, 3 all or a whole block), ``cycle`` (how
    often the walk was heated again) and ``stands``: the number, from 1, of the evaluation at whose point the walk
    stands after the step.
    """

    exploration: float = Field(default=0.05, ge=0.0, le=1.0)
    """Share of the candidates that are uniform in the whole box."""

    one: float = Field(default=0.7, ge=0.0)
    """Weight of moves of one coordinate."""

    few: float = Field(default=0.15, ge=0.0)
    """Weight of moves of two or three coordinates; in a space of tuples, of two or three whole blocks."""

    full: float = Field(default=0.15, ge=0.0)
    """Weight of moves of all coordinates; in a space of tuples, of one whole block."""

    acting: float = Field(default=0.8, ge=0.0, le=1.0)
    """Share of the moves that choose among the coordinates on which the value rests, where the objective knows them;
    the others choose among all, so that what does not count yet has its turn."""

    coarse: float = Field(default=0.2, ge=0.0, le=1.0)
    """Share of the moves that keep the initial scale, to cross from basin to basin when the adapted scale is small; a
    coarse move of a block draws it anew."""

    step: Literal["cauchy", "gaussian"] = "cauchy"
    """Distribution of the steps: Cauchy's makes a long one now and then."""

    initial_scale: float = Field(default=0.1, gt=0.0, le=0.5)
    """Scale of the first steps, in widths of the box."""

    adapt: Literal["coordinate", "global", "none"] = "coordinate"
    """One scale per coordinate (per place within a block), one for all, or no adaptation; one for all, too, when the
    budget allows less than 20 evaluations for each."""

    adaptation: float = Field(default=0.3, gt=0.0, le=2.0)
    """Rate at which a scale follows the acceptance."""

    acceptance: float = Field(default=0.25, gt=0.0, lt=1.0)
    """Share of accepted moves that the scales aim at."""

    cooling: Literal["geometric", "logarithmic", "gap"] = "geometric"
    """Geometric from the first to the last temperature; proportional to 1 / log(evaluations), which hardly cools within
    a usual budget; or driven by the gap between the walk and the best value (Locatelli 2000)."""

    initial_temperature: float | None = Field(default=None, gt=0.0)
    """First temperature, in units of the function; none: from the spread of the first values."""

    temperature_share: float = Field(default=0.5, gt=0.0)
    """First temperature over the spread (median absolute deviation) of the first values, where it is not given."""

    cooling_range: float = Field(default=1e-10, gt=0.0, lt=1.0)
    """Last temperature over the first one."""

    gap_factor: float = Field(default=0.1, gt=0.0)
    """Temperature over the gap, for ``cooling: gap``."""

    gap_power: float = Field(default=1.0, gt=0.0)
    """Power of the gap, for ``cooling: gap``."""

    restarts: int = Field(default=2, ge=0)
    """How often the walk is heated again, its scales widened again; the budget is shared equally. A rule that ends the
    search at a temperature ends it within the first cycle; choose 0 restarts with it."""

    restart_from: Literal["best", "anew"] = "best"
    """Where a restarted walk begins: at the best point so far, or at the best of the next few uniform points."""

    reheat: float = Field(default=0.1, gt=0.0, le=1.0)
    """First temperature of a cycle over that of the cycle before."""

    samples: int = Field(default=10, ge=1)
    """Uniform points to begin with, at most a tenth of the budget; the walk starts at the best of them, or at a better
    point that the objective has already."""

    @model_validator(mode="after")
    def _some_move(self) -> SimulatedAnnealing:
        if not self.one + self.few + self.full > 0.0:
            raise ValueError("one, few, full: at least one of the weights must be positive")
        return self

    def search(self, objective: sr.Objective, rng: np.random.Generator) -> float:
        """Search until the budget is spent and return ``inf``, as no upper bound is proven; see
        `sparserob_core.Maximiser`."""
        moves = Moves(self, objective, rng)
        walk = _Walk(objective, rng, moves)
        start = first_temperature(self, walk.begin(self._uniform(objective, moves)))
        lowest = start * self.cooling_range
        for cycle in range(self.restarts + 1):
            if cycle:
                moves.restart()
                start *= self.reheat
                walk.restart(None if self.restart_from == "best" else self._uniform(objective, moves))
            length = objective.remaining // (self.restarts + 1 - cycle)
            walk.go(Cooling(self, start, lowest, length))
        return float("inf")

    def _uniform(self, objective: sr.Objective, moves: Moves) -> np.ndarray:
        return moves.uniform(max(1, min(self.samples, objective.remaining // 10)))


class _Walk:
    """State of the walk: a point, its value, and the number of the evaluation that it is from (0: of one before the
    search). ``best`` is that number of the best point."""

    def __init__(self, objective: sr.Objective, rng: np.random.Generator, moves: Moves) -> None:
        self.objective, self.rng, self.moves = objective, rng, moves
        self.point, self.value, self.number = objective.best_point, -np.inf, 0
        self.best, self.cycle = int(objective.evaluations == 1), 0
        self.acting: np.ndarray | None = None
        self.told = getattr(objective, "acting", None)  # an objective of somebody else may not have it

    def begin(self, points: np.ndarray) -> np.ndarray:
        """Evaluate the first points, and stand at the best that is known; return their values."""
        values = self._sampled(points)
        self._to_best()
        return values

    def restart(self, points: np.ndarray | None) -> None:
        """Heat up again, at the best point, or at the best of some new ones."""
        self.cycle += 1
        if points is None or not self.objective.remaining:
            self._to_best()
            return
        evaluations = self.objective.evaluations
        values = self._sampled(points)
        best = int(np.argmax(values))
        self.point, self.value, self.number, self.acting = (
            points[best],
            float(values[best]),
            evaluations + best + 1,
            None,
        )

    def go(self, cooling: Cooling) -> None:
        """Run one cycle of the walk."""
        objective = self.objective
        for k in range(cooling.length):
            temperature = cooling.temperature(k, objective.best_value - self.value)
            candidate, record = self.moves.candidate(self.point, self.acting), objective.best_value
            value = float(objective.evaluate(candidate[np.newaxis])[0])
            if value > record:
                self.best = objective.evaluations
            # There is nothing to lose where the function has no value, and a rule cannot be asked about -inf less -inf.
            accepted = self.value == -np.inf or objective.accepts(self.value, value, temperature, self.rng)
            self.moves.learn(accepted)
            if accepted:
                self.point, self.value, self.number = candidate, value, objective.evaluations
                self.acting = None if self.told is None else np.flatnonzero(self.told())
            objective.note(
                temperature=temperature,
                accepted=float(accepted),
                scale=self.moves.scale,
                stands=self.number,
                cycle=self.cycle,
                move=self.moves.kind,
            )

    def _sampled(self, points: np.ndarray) -> np.ndarray:
        evaluations, record = self.objective.evaluations, self.objective.best_value
        values = self.objective.evaluate(points)
        if values.max() > record or not evaluations:
            self.best = evaluations + int(values.argmax()) + 1
        return values

    def _to_best(self) -> None:
        self.point, self.value, self.number = self.objective.best_point, self.objective.best_value, self.best
        self.acting = None


@sr.hookimpl
def sparserob_maximisers() -> Iterator[sr.MaximiserPlugin]:
    """Offer ``simulated_annealing``."""
    yield sr.MaximiserPlugin(
        name="simulated_annealing", factory=SimulatedAnnealing, summary="cooled walk of few-coordinate moves"
    )
