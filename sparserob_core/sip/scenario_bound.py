"""What the scenario theory says of a decision that was made for random scenarios: a probability, never a worst case."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import final

import numpy as np

from sparserob_core.arguments import whole
from sparserob_core.errors import InputError

SURE = 1e-6  # the probability beta of drawing scenarios for which a bound fails


@final
@dataclass(frozen=True)
class ScenarioBound:
    """With confidence ``1 - beta`` over the draw of ``scenarios``, one more uncertainty drawn by the same law breaks a
    constraint with probability at most ``before`` (Campi and Garatti 2008: from the number ``variables`` of decision
    variables alone) and at most ``after`` (Campi and Garatti 2018: from the number ``support`` of imposed constraints
    that carry a multiplier, which the support constraints are among).

    Both are for convex programs whose optimiser is unique, ``after`` also supposes non-degeneracy; 1 means that nothing
    is said.
    """

    scenarios: int
    variables: int
    support: int
    beta: float
    before: float
    after: float

    @property
    def sentence(self) -> str:
        """The bound in words, and what it is about."""
        known = f"{at_most(self.before)} from the {self.variables} decision variables alone"
        if self.before == 1.0:
            known = f"nothing from the {self.variables} decision variables alone, for which these are too few scenarios"
        return (
            f"with confidence 1 - {self.beta:g} an uncertainty drawn like the {self.scenarios} scenarios breaks a"
            f" constraint with probability at most {at_most(self.after)} (seen {self.support} active constraints;"
            f" {known}), which is a probability under the sampling law and does not bound the worst case"
        )


def at_most(bound: float) -> str:
    """An upper bound in ``(0, infinity)`` to two digits, rounded up."""
    digits = 1 - int(np.floor(np.log10(bound)))
    return f"{np.ceil(round(bound * 10.0**digits, 9)) / 10.0**digits:.2g}"


def scenario_bound(scenarios: int, variables: int, support: int, beta: float = SURE) -> ScenarioBound:
    """The bounds before and after a scenario program was solved; raises `InputError` for counts and probabilities that
    make no sense."""
    return ScenarioBound(
        scenarios,
        variables,
        support,
        beta,
        bound_before(scenarios, variables, beta),
        bound_after(scenarios, support, beta),
    )


def bound_before(scenarios: int, variables: int, beta: float = SURE) -> float:
    """The ``epsilon`` with ``sum_{i < n} C(S, i) epsilon^i (1 - epsilon)^(S - i) = beta``; 1 when ``S < n``.

    Campi and Garatti (2008), SIAM J. Optim. 19, 1211-1230, Theorem 1; ``S`` scenarios,
    ``n`` decision variables. The sum is a binomial tail, so ``epsilon`` is a quantile of the beta distribution with
    ``n`` and ``S - n + 1``.
    """
    from scipy.special import betaincinv

    _check(scenarios, "variables", variables, 1, beta)
    if scenarios < variables:
        return 1.0
    return 1.0 - float(betaincinv(scenarios - variables + 1, variables, beta))


def bound_after(scenarios: int, support: int, beta: float = SURE) -> float:
    """The ``epsilon = 1 - t`` with ``beta / (S + 1) sum_{m=k}^S C(m, k) t^(m-k) = C(S, k) t^(S-k)``; 1 when ``k >= S``.

    Campi and Garatti (2018), "Wait-and-judge", Math. Program. 167, 155-189, Theorem 1; ``S`` scenarios, ``k`` support
    constraints. The finite sum is ``epsilon^(-k-1) P(X > k)`` with ``X`` binomial of ``S + 1`` trials and probability
    ``epsilon``, which makes the equation ``beta P(X > k) = (k + 1) P(X = k + 1)``; the ratio of the two sides is
    monotone in ``epsilon``. It grows with ``k``.
    """
    from scipy.optimize import brentq

    _check(scenarios, "support", support, 0, beta)
    if support >= scenarios:
        return 1.0
    surplus = partial(_log_ratio, scenarios, support, np.log(beta))
    below, above = 1e-300, 1.0 - 1e-16
    return 1.0 if surplus(above) > 0 else float(brentq(surplus, below, above, xtol=1e-300, rtol=1e-13))


def _log_ratio(scenarios: int, support: int, level: float, epsilon: float) -> float:
    """``log((k + 1) P(X = k + 1) / P(X > k)) - log(beta)``: decreasing in ``epsilon``."""
    m = np.arange(support + 1, scenarios + 2)
    return float(-np.logaddexp.reduce(_log_terms(scenarios, support, epsilon, m)) + np.log(support + 1) - level)


def _log_terms(scenarios: int, support: int, epsilon: float, m: np.ndarray) -> np.ndarray:
    """``log(P(X = m) / P(X = k + 1))``."""
    from scipy.special import gammaln

    def log_choose(j: np.ndarray | int) -> np.ndarray:
        return np.asarray(-gammaln(np.asarray(j) + 1.0) - gammaln(scenarios + 2.0 - np.asarray(j)))

    return np.asarray(
        log_choose(m) - log_choose(support + 1) + (m - support - 1) * (np.log(epsilon) - np.log1p(-epsilon))
    )


def _check(scenarios: int, name: str, count: int, least: int, beta: float) -> None:
    whole("scenarios", scenarios, 1)
    whole(name, count, least)
    if not 0.0 < beta < 1.0:
        raise InputError(f"beta: expected a probability between 0 and 1, got {beta!r}")
