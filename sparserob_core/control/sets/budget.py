"""Boxes of signals with a budget over time, after Bertsimas and Sim (2004), The Price of Robustness."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, final

import numpy as np
import numpy.typing as npt

from sparserob_core.errors import InputError
from sparserob_core.shapes import Float, sealed, shaped
from sparserob_core.sip.convex_set import Array, Box, ConvexSet

# Share of itself by which a signal is shortened, so that it is inside although its sums are rounded. A hundredth of it
# is the rounding itself; with a thousand times as much, values of worst signals would lose a digit that is reported.
INSIDE = 1e-13


@final
@dataclass(frozen=True, eq=False)
class BudgetedBox(Box):
    """The box ``|w_i| <= upper_i``, for signals ``w(t)`` with ``int sum_i |w_i|^p dt <= size`` over the horizon.

    As a set of values it is the box. The budget couples the values at different times (`of_signals`).

    Parameters
    ----------
    lower, upper : array_like, shape (mw,)
        Bounds of the values; the box is symmetric about 0.
    p : {1, 2}, default 1
        The power.
    size : float, default inf
        The budget, positive, in units of ``|w|^p`` times the unit of time. Channels in other units are added as they
        are.
    rates : array_like, shape (mw,), optional
        What the budget pays for ``|w_i|^p = 1`` during a unit of time; 1 unless given.

    Raises
    ------
    InputError
        Where the box is not symmetric about 0 or unbounded, or the budget is not as described.

    Examples
    --------
    >>> import sparserob_core as sr
    >>> gust = sr.BudgetedBox([-1.0], [1.0], p=1, size=0.5)
    >>> gust.of_signals([0.25, 0.25, 0.5]).support([1.0, 3.0, 2.0]).item()
    4.0
    """

    p: int = 1
    size: float = np.inf
    rates: Array = field(default_factory=lambda: np.ones(1))

    if TYPE_CHECKING:  # arguments may be lists; the fields are arrays

        def __init__(
            self,
            lower: npt.ArrayLike,
            upper: npt.ArrayLike,
            p: int = 1,
            size: float = np.inf,
            rates: npt.ArrayLike = 1.0,
        ) -> None: ...

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.is_bounded or (self.lower != -self.upper).any():
            expected = "a bounded box that is symmetric about 0, such as box: 0.1, beside a budget"
            raise InputError(path="box", expected=expected, got=f"{self.lower.tolist()} to {self.upper.tolist()}")
        if self.p not in (1, 2):
            raise InputError(path="budget.p", expected="1 or 2", got=f"{self.p!r}")
        if not 0.0 < self.size < np.inf:
            raise InputError(path="budget.size", expected="a positive number", got=f"{self.size!r}")
        object.__setattr__(self, "rates", np.broadcast_to(np.array(self.rates, dtype=float), self.lower.shape).copy())
        sealed(self)

    @property
    def is_pointwise(self) -> bool:
        return False

    @shaped
    def of_signals(self, lengths: Float[Array, " n"]) -> BudgetedSignals:
        """Return the set of signals ``(mw n,)`` that are constant on intervals of such ``lengths (n,)``, one channel
        after another."""
        lengths = np.asarray(lengths, dtype=float)
        return BudgetedSignals(
            np.repeat(self.upper, lengths.size), np.outer(self.rates, lengths).ravel(), self.p, float(self.size)
        )

    def scaled(self, factor: float) -> Box:
        """Return the set of all signals times a factor; the budget is multiplied by its power ``p``."""
        if factor <= 0.0:
            return Box(0.0 * self.lower, 0.0 * self.upper)
        return BudgetedBox(factor * self.lower, factor * self.upper, self.p, self.size * factor**self.p, self.rates)

    @shaped
    def in_units(self, units: Float[Array, " d"]) -> BudgetedBox:
        units = np.asarray(units, dtype=float)
        return BudgetedBox(self.lower / units, self.upper / units, self.p, self.size, self.rates * units**self.p)

    def in_units_of_time(self, unit: float) -> BudgetedBox:
        return BudgetedBox(self.lower, self.upper, self.p, self.size / unit, self.rates)


@final
@dataclass(frozen=True, eq=False)
class BudgetedSignals(ConvexSet):
    """The set ``{x : |x_i| <= radii_i, sum_i costs_i |x_i|^p <= size}``, ``p`` 1 or 2.

    For ``p = 1`` the support function is a knapsack: the budget is spent where ``|c_i| / costs_i`` is largest. For
    ``p = 2`` the maximiser is ``|x_i| = min(|c_i| / (2 lambda costs_i), radii_i)``, with the ``lambda`` at which the
    budget is spent.

    Parameters
    ----------
    radii, costs : array (q,)
        Bounds of the coordinates, and what the budget pays for each.
    p : int
        The power.
    size : float
        The budget.
    """

    radii: Array
    costs: Array
    p: int
    size: float

    @property
    def dimension(self) -> int:
        return int(self.radii.size)

    @property
    def kind(self) -> str:
        return "box with a budget"

    @property
    def is_symmetric(self) -> bool:
        return True

    @shaped
    def support(self, directions: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        sizes = np.abs(np.asarray(directions, dtype=float))
        return np.asarray((sizes * self._spend(sizes)).sum(axis=-1))

    @shaped
    def support_point(self, directions: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        directions = np.asarray(directions, dtype=float)
        return np.asarray(np.sign(directions) * self._spend(np.abs(directions)))

    @shaped
    def reach(self, directions: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        return self.support(directions)

    @shaped
    def interior_point(self) -> Float[Array, " d"]:
        return np.zeros(self.dimension)

    @shaped
    def gauge(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        sizes = np.abs(np.asarray(points, dtype=float))
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.where(sizes > 0.0, sizes / self.radii, 0.0).max(axis=-1, initial=0.0)
        spent = (self.costs * sizes**self.p).sum(axis=-1) / self.size
        return np.asarray(np.maximum(shares, spent ** (1.0 / self.p)))

    @shaped
    def violation(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        gauge = self.gauge(points)
        length = np.where(gauge > 1.0, np.linalg.norm(points, axis=-1), float(self.radii.min(initial=np.inf)))
        return np.asarray(length * (1.0 - 1.0 / np.maximum(gauge, 1.0)) + length * np.minimum(gauge - 1.0, 0.0))

    @shaped
    def inside(self, points: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        return np.asarray(points) * (1.0 - INSIDE)

    @shaped
    def sample(self, count: int, rng: np.random.Generator) -> Float[Array, "{count} d"]:
        """Return random points: those of the box, shortened to a random share of the budget where they exceed it."""
        points = rng.uniform(-self.radii, self.radii, size=(count, self.dimension))
        shares = rng.uniform(size=count) ** (1.0 / self.dimension)
        gauge = self.gauge(points)
        return np.asarray(points * np.where(gauge > 1.0, shares / np.maximum(gauge, 1.0), 1.0)[:, None])

    def _spend(self, sizes: Array) -> Array:
        """Return the absolute values ``(..., q)`` of the maximiser in directions of the absolute values ``sizes``."""
        radii, costs = np.broadcast_to(self.radii, sizes.shape), np.broadcast_to(self.costs, sizes.shape)
        prices = sizes / (costs * radii ** (self.p - 1)) if self.p == 1 else self._divide(sizes, 2.0 * costs * radii)
        order = np.argsort(-prices, axis=-1, kind="stable")
        sizes, radii, costs, prices = (np.take_along_axis(v, order, axis=-1) for v in (sizes, radii, costs, prices))
        full = costs * radii**self.p
        left = self.size - (full.cumsum(axis=-1) - full)  # before each coordinate, at its radius all those before it
        if self.p == 1:
            spent = np.clip(left / costs, 0.0, radii)
        else:
            squares = sizes**2 / (4.0 * costs)
            unbound = np.flip(np.flip(squares, axis=-1).cumsum(axis=-1), axis=-1)
            with np.errstate(divide="ignore", invalid="ignore"):
                multipliers = np.where(left > 0.0, np.sqrt(unbound / np.maximum(left, 0.0)), np.inf)
            is_first = multipliers >= prices  # from this coordinate on none is at its radius
            first = np.where(is_first.any(axis=-1), is_first.argmax(axis=-1), -1)[..., None]
            multiplier = np.where(first >= 0, np.take_along_axis(multipliers, np.maximum(first, 0), axis=-1), 0.0)
            spent = np.minimum(self._divide(sizes, 2.0 * multiplier * costs), radii)
        result = np.empty_like(spent)
        np.put_along_axis(result, order, np.where(sizes > 0.0, spent, 0.0), axis=-1)
        return result

    @staticmethod
    def _divide(sizes: Array, by: Array) -> Array:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(sizes > 0.0, sizes / by, 0.0)
