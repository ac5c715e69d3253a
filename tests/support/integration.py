"""Linear differential equations integrated in fifty digits, for tests: nothing of the package is in them."""

from __future__ import annotations

from decimal import Decimal, localcontext

TERMS, STEP = 40, Decimal("0.125")  # (h * 2)^40 / 40! is below 1e-70


def mathieu(a: str, q: str, stop: Decimal) -> list[list[float]]:
    """The transition from 0 to ``stop`` of ``x'' = -(a - 2 q cos 2 t) x``, to 50 digits: Taylor series of the solution,
    of ``cos 2 t`` and of ``sin 2 t``, on steps of `STEP`."""
    with localcontext() as context:
        context.prec = 60
        columns, c, s, t = [[Decimal(1), Decimal(0)], [Decimal(0), Decimal(1)]], Decimal(1), Decimal(0), Decimal(0)
        while t < stop:
            h = min(STEP, stop - t)
            cosine, sine = [c], [s]
            for n in range(TERMS):
                cosine.append(-2 * sine[n] / (n + 1))
                sine.append(2 * cosine[n] / (n + 1))
            law = [-(Decimal(a) if n == 0 else Decimal(0)) + 2 * Decimal(q) * cosine[n] for n in range(TERMS)]
            columns = [_stepped(x, v, law, h) for x, v in columns]
            c, s, t = _at(cosine, h), _at(sine, h), t + h
        return [[float(column[row]) for column in columns] for row in range(2)]


def _stepped(x: Decimal, v: Decimal, law: list[Decimal], h: Decimal) -> list[Decimal]:
    terms = [x, v]
    for n in range(TERMS - 1):
        driven = sum((law[k] * terms[n - k] for k in range(n + 1)), Decimal(0))
        terms.append(driven / ((n + 1) * (n + 2)))
    return [_at(terms, h), _at([n * term for n, term in enumerate(terms)][1:], h)]


def _at(terms: list[Decimal], h: Decimal) -> Decimal:
    total = Decimal(0)
    for term in reversed(terms):
        total = total * h + term
    return total
