"""Scenario theory for a decision made for random scenarios: bounds of a probability, never of a worst case."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import final

import numpy as np

from sparserob_core.arguments import whole
from sparserob_core.errors import InputError

FAILURE_PROBABILITY = 1e-6  # the probability beta of drawing scenarios for which a bound fails


@final
@dataclass(frozen=True)
class ScenarioBound:
    """Bounds of the probability that a new uncertainty breaks a constraint, with confidence ``1 - beta`` over the
    scenarios.

    The new uncertainty is drawn by the same law as the scenarios. Both bounds hold for convex programs with a unique
    optimiser; ``after`` also supposes non-degeneracy. A bound of 1 states nothing.

    Parameters
    ----------
    scenarios : int
        Number of scenarios.
    variables : int
        Number of decision variables.
    support : int
        Number of imposed constraints with a multiplier; the support constraints are among them.
    beta : float
        Probability that a bound fails.
    before : float
        Bound from ``variables`` alone (Campi and Garatti 2008).
    after : float
        Bound from ``support`` (Campi and Garatti 2018).
    """

    scenarios: int
    variables: int
    support: int
    beta: float
    before: float
    after: float

    @property
    def sentence(self) -> str:
        """The bounds in words, with their meaning."""
        prior = f"{at_most(self.before)} from the {self.variables} decision variables alone"
        if self.before == 1.0:
            prior = f"nothing from the {self.variables} decision variables alone, for which these are too few scenarios"
        return (
            f"with confidence 1 - {self.beta:g} an uncertainty drawn like the {self.scenarios} scenarios breaks a"
            f" constraint with probability at most {at_most(self.after)} (seen {self.support} active constraints;"
            f" {prior}), which is a probability under the sampling law and does not bound the worst case"
        )


def at_most(bound: float) -> str:
    """Return an upper bound in ``(0, infinity)`` as a text of two digits, rounded up."""
    digits = 1 - int(np.floor(np.log10(bound)))
    return f"{np.ceil(round(bound * 10.0**digits, 9)) / 10.0**digits:.2g}"


def scenario_bound(scenarios: int, variables: int, support: int, beta: float = FAILURE_PROBABILITY) -> ScenarioBound:
    """Return the bounds of a scenario program, from before and after its solution.

    Parameters
    ----------
    scenarios : int
        Number of scenarios, at least 1.
    variables : int
        Number of decision variables, at least 1.
    support : int
        Number of imposed constraints with a multiplier, at least 0.
    beta : float, default SURE
        Probability that a bound fails, between 0 and 1.

    Returns
    -------
    ScenarioBound
        Both bounds.

    Raises
    ------
    InputError
        Where a count or the probability is out of its range.
    """
    return ScenarioBound(
        scenarios,
        variables,
        support,
        beta,
        bound_before(scenarios, variables, beta),
        bound_after(scenarios, support, beta),
    )


def bound_before(scenarios: int, variables: int, beta: float = FAILURE_PROBABILITY) -> float:
    """Return the ``epsilon`` with ``sum_{i < n} C(S, i) epsilon^i (1 - epsilon)^(S - i) = beta``; 1 when ``S < n``.

    ``S`` is the number of scenarios, ``n`` that of decision variables. The sum is a binomial tail, so ``epsilon`` is a
    quantile of the beta distribution with parameters ``n`` and ``S - n + 1``.

    References
    ----------
    Campi and Garatti (2008), SIAM J. Optim. 19, 1211-1230, Theorem 1.
    """
    from scipy.special import betaincinv

    _check_arguments(scenarios, "variables", variables, 1, beta)
    if scenarios < variables:
        return 1.0
    return 1.0 - float(betaincinv(scenarios - variables + 1, variables, beta))


def bound_after(scenarios: int, support: int, beta: float = FAILURE_PROBABILITY) -> float:
    """Return ``epsilon = 1 - t`` with ``beta / (S + 1) sum_{m=k}^S C(m, k) t^(m-k) = C(S, k) t^(S-k)``; 1 when ``k >=
    S``.

    ``S`` is the number of scenarios, ``k`` that of support constraints. The finite sum is ``epsilon^(-k-1) P(X > k)``
    with ``X`` binomial of ``S + 1`` trials and probability ``epsilon``. So the equation reads ``beta P(X > k) = (k + 1)
    P(X = k + 1)``. The ratio of the two sides is monotone in ``epsilon``. The bound grows with ``k``.

    References
    ----------
    Campi and Garatti (2018), "Wait-and-judge", Math. Program. 167, 155-189, Theorem 1.
    """
    from scipy.optimize import brentq

    _check_arguments(scenarios, "support", support, 0, beta)
    if support >= scenarios:
        return 1.0
    surplus = partial(_compute_log_ratio, scenarios, support, np.log(beta))
    below, above = 1e-300, 1.0 - 1e-16
    return 1.0 if surplus(above) > 0 else float(brentq(surplus, below, above, xtol=1e-300, rtol=1e-13))


def _compute_log_ratio(scenarios: int, support: int, level: float, epsilon: float) -> float:
    """Return ``log((k + 1) P(X = k + 1) / P(X > k)) - log(beta)``, which decreases in ``epsilon``."""
    m = np.arange(support + 1, scenarios + 2)
    return float(-np.logaddexp.reduce(_compute_log_terms(scenarios, support, epsilon, m)) + np.log(support + 1) - level)


def _compute_log_terms(scenarios: int, support: int, epsilon: float, m: np.ndarray) -> np.ndarray:
    """Return ``log(P(X = m) / P(X = k + 1))``."""
    from scipy.special import gammaln

    def log_choose(j: np.ndarray | int) -> np.ndarray:
        return np.asarray(-gammaln(np.asarray(j) + 1.0) - gammaln(scenarios + 2.0 - np.asarray(j)))

    return np.asarray(
        log_choose(m) - log_choose(support + 1) + (m - support - 1) * (np.log(epsilon) - np.log1p(-epsilon))
    )


def _check_arguments(scenarios: int, name: str, count: int, least: int, beta: float) -> None:
    whole("scenarios", scenarios, 1)
    whole(name, count, least)
    if not 0.0 < beta < 1.0:
        raise InputError(f"beta: expected a probability between 0 and 1, got {beta!r}")
