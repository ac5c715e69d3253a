"""Power series in the time, with balls as coefficients, on which the expressions of a system act."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.jets import kepler_series
from sparserob_core.checker.outcome import Unchecked

if TYPE_CHECKING:
    from flint import arb, arb_series

_LARGEST_POWER = 64


@final
class Timed:
    """``series`` in ``s`` of a function of ``t = centre + s``, for every ``centre`` of a ball."""

    __slots__ = ("series",)

    def __init__(self, series: arb_series) -> None:
        self.series = series

    @staticmethod
    def time(centre: arb, length: int) -> Timed:
        """The time itself, to ``length`` terms."""
        from flint import arb_series

        return Timed(arb_series([centre, 1], length))

    def coefficients(self, length: int) -> list[arb]:
        """The first ``length`` coefficients; raises `Unchecked` where one is not finite, or not known."""
        if self.series.prec < length:  # what is beyond would read as 0
            raise Unchecked("an entry of the system has no expansion in time")
        found = [self.series[k] for k in range(length)]
        if not all(one.is_finite() for one in found):
            raise Unchecked("an entry of the system is not finite")
        return found

    def _other(self, value: object) -> arb_series:
        from flint import arb_series

        if isinstance(value, Timed):
            return value.series
        if isinstance(value, int | float | np.integer | np.floating):
            return arb_series([float(value)], self.series.prec)
        raise Unchecked(f"an entry of the system holds a {type(value).__name__}, expected a number")

    def __add__(self, other: object) -> Timed:
        return Timed(self.series + self._other(other))

    def __neg__(self) -> Timed:
        return Timed(-self.series)

    def __pos__(self) -> Timed:
        return self

    def __sub__(self, other: object) -> Timed:
        return Timed(self.series - self._other(other))

    def __rsub__(self, other: object) -> Timed:
        return Timed(self._other(other) - self.series)

    def __mul__(self, other: object) -> Timed:
        return Timed(self.series * self._other(other))

    def __truediv__(self, other: object) -> Timed:
        return _quotient(self.series, self._other(other))

    def __rtruediv__(self, other: object) -> Timed:
        return _quotient(self._other(other), self.series)

    def __pow__(self, other: object) -> Timed:
        if isinstance(other, int | float | np.integer | np.floating) and float(other).is_integer():
            count = int(other)
            if 0 <= count <= _LARGEST_POWER:
                result = Timed(self._other(1.0))
                for _ in range(count):
                    result = result * self
                return result
            if -_LARGEST_POWER <= count < 0:
                return 1.0 / self**-count
        return (Timed(self._other(other)) * self.log()).exp()

    def __rpow__(self, other: object) -> Timed:
        return Timed(self._other(other)) ** self

    __radd__, __rmul__ = __add__, __mul__

    def _of(self, function: Callable[[arb_series], arb_series]) -> Timed:
        try:
            return Timed(function(self.series))
        except (ValueError, ZeroDivisionError) as error:
            raise Unchecked(f"an entry of the system is not finite ({error})") from error

    def exp(self) -> Timed:
        return self._of(lambda s: s.exp())

    def sin(self) -> Timed:
        return self._of(lambda s: s.sin())

    def cos(self) -> Timed:
        return self._of(lambda s: s.cos())

    def tan(self) -> Timed:
        return self._of(lambda s: s.tan())

    def log(self) -> Timed:
        return self._of(lambda s: s.log())

    def sqrt(self) -> Timed:
        return self._of(lambda s: s.sqrt())

    def tanh(self) -> Timed:
        return 1.0 - 2.0 / ((self * 2.0).exp() + 1.0)  # a ball is there once, so that of wide ones little is lost

    def kepler(self, eccentricity: float) -> Timed:
        return self._of(lambda s: kepler_series(s, eccentricity, s.prec))


def _quotient(over: arb_series, under: arb_series) -> Timed:
    try:
        return Timed(over / under)
    except (ValueError, ZeroDivisionError) as error:
        raise Unchecked(f"an entry of the system is not finite ({error})") from error
