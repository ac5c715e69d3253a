"""Guards discs around values of entries, and what Cauchy's bound says of their power series in the parameters: discs
hold every value and are not much larger, no remainder is larger than what is said, poles are named."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.enclosures.dependence import Split
from sparserob_core.control.response.varying.discs import Discs, cauchy

rng = np.random.default_rng(59)


def kepler(M: np.ndarray, e: float) -> np.ndarray:
    E = M + 0j
    for _ in range(100):
        E = E - (E - e * np.sin(E) - M) / (1 - e * np.cos(E))
    return E


EVERY: dict[
    str, tuple[Callable[[Discs], Discs], Callable[[np.ndarray], np.ndarray], list[tuple[float, float]], float]
] = {
    "exp": (lambda d: d.exp(), np.exp, [(0.3, 0.5), (-2.0, 3.0)], 1.01),
    "log": (lambda d: d.log(), np.log, [(0.3, 0.2), (5.0, 4.9)], 1.01),
    "sqrt": (lambda d: d.sqrt(), np.sqrt, [(0.3, 0.2), (5.0, 4.9)], 1.01),
    "a power": (lambda d: d**-1.5, lambda z: z**-1.5, [(0.3, 0.2), (5.0, 4.0)], 1.01),
    "a cube": (lambda d: d**3, lambda z: z**3, [(0.3, 0.2), (-1.0, 0.4)], 1.01),
    "the inverse": (lambda d: 1.0 / d, lambda z: 1.0 / z, [(0.3, 0.2), (-5.0, 4.0)], 1.01),
    "sin": (lambda d: d.sin(), np.sin, [(0.0, 0.7), (1.0, 0.6), (1.5, 2.0)], 1.5),
    "cos": (lambda d: d.cos(), np.cos, [(0.0, 0.7), (1.0, 0.6), (1.6, 2.0)], 1.5),
    "tan": (lambda d: d.tan(), np.tan, [(0.0, 0.7), (1.0, 0.3), (4.0, 0.3)], 1.01),
    "tanh": (lambda d: d.tanh(), np.tanh, [(0.0, 0.7), (1.0, 0.3), (-4.0, 0.6)], 2.5),
    "a product": (lambda d: d * (d + 2.0), lambda z: z * (z + 2.0), [(1.0, 0.3)], 1.01),
    "a difference": (lambda d: 1.0 - d / 4.0, lambda z: 1.0 - z / 4.0, [(1.0, 0.3)], 1.01),
    "kepler": (lambda d: d.kepler(0.3), lambda z: kepler(z, 0.3), [(0.4, 0.2), (3.0, 0.6)], 1.4),
}


@pytest.mark.parametrize("name", EVERY)
def test_discs_hold_every_value_and_little_more(name: str) -> None:
    enclosed, exact, cases, most = EVERY[name]
    for middle, radius in cases:
        disc = enclosed(Discs(np.array(middle), np.array(radius)))
        z = middle + radius * np.exp(2j * np.pi * np.linspace(0.0, 1.0, 721))
        far = float(np.abs(exact(z) - disc.middle).max())
        assert far <= disc.radius <= most * far


@pytest.mark.parametrize(
    ("made", "disc"),
    [
        ("log", (1.0, 1.0)),
        ("sqrt", (-1.0, 0.5)),
        ("reciprocal", (0.5, 0.5)),
        ("tan", (1.5, 0.1)),
        ("exp", (800.0, 1.0)),
    ],
)
def test_of_discs_around_a_pole_nothing_is_known(made: str, disc: tuple[float, float]) -> None:
    assert np.isinf(getattr(Discs(*map(np.array, disc)), made)().radius)


ENTRIES = [
    "exp(-p*t)", "1/(1+p)", "sin(p*t)", "sqrt(1+p*cos(t))", "log(2+p*t)", "tan(p*t/4)", "tanh(p+t)", "(1+p)^1.5",
    "p^9*t", "exp(sin(p*t))/(2+p^2)", pytest.param("kepler(t+p, 0.3)", marks=pytest.mark.slow),
]  # fmt: skip


@pytest.mark.parametrize("text", ENTRIES)
def test_what_is_beyond_a_degree_is_bounded_and_not_by_far_more_than_it_is(text: str) -> None:
    box = sr.Box([-0.3], [0.4])
    system = sr.VaryingSystem.of([[text]], [["1"]], 2.0, [[1]], parameters=box, names=["p"])
    known, (centre, units), entry = cauchy(system), system.deviations, system.phases[0].entry("A")
    for degree in (1, 4, 7):
        left = known.bound_remainder(degree)
        assert (left.sizes[:, :, 1:] == 0.0).all()
        share = 0.0
        for number in range(0, left.ends.size - 1, 5):
            off, begin, until = 0.0, left.ends[number], left.ends[number + 1]
            for t in (begin, until, float(rng.uniform(begin, until))):
                parts = Split.of(entry, t, centre, units, degree).parts
                p = np.concatenate([[-0.3, 0.4], rng.uniform(-0.3, 0.4, 5)])
                polynomial = sum(
                    float(one[0, 0]) * ((p - centre[0]) / units[0]) ** key[0] for key, one in parts.items()
                )
                exact = np.array([float(np.asarray(entry(np.array([t, one], dtype=object)))[0, 0]) for one in p])
                off = max(off, float(np.abs(exact - polynomial).max()))
            assert off <= left.sizes[number, 0, 0] * (1 + 1e-9) + 1e-14
            share = max(share, off / left.sizes[:, 0, 0].max())
        assert share > 1e-6


@pytest.mark.parametrize(
    ("text", "box", "told"),
    [
        ("1/(1+p)", (-1.3, 0.4), "p = -1"),
        ("1/(t-p)", (1.0, 1.3), "p = 1."),
        ("sqrt(p - sin(t))", (0.95, 3.0), "p = 0.9"),
        ("log(1.02 - p*sin(t))", (0.9, 1.1), "p = 1"),
        ("tan(p*t)", (0.5, 0.9), "p = 0.8"),
    ],
)
def test_a_pole_is_an_error_with_its_time_and_parameters(text: str, box: tuple[float, float], told: str) -> None:
    system = sr.VaryingSystem.of([["0*t"]], [[text]], 2.0, [[1]], parameters=sr.Box([box[0]], [box[1]]), names=["p"])
    with pytest.raises(
        sr.InputError, match=rf"system: expected entries .*, got {re.escape(text)}, .*near t = .*{told}"
    ):
        cauchy(system)
