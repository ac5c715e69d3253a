"""The colours of a recording, as red, green, blue, opacity: those of the figures, light enough for the viewer's dark
ground.

Okabe and Ito (2008), "Color universal design"; a colour means the same thing in every panel.
"""

from __future__ import annotations

from functools import cache
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Colour: TypeAlias = tuple[int, int, int, int]
Floats: TypeAlias = npt.NDArray[np.float64]

SKY: Colour = (86, 180, 233, 255)  # the decision: control, nominal state, the current point
TUBE: Colour = (86, 180, 233, 70)  # the worst case over everything uncertain
VERMILLION: Colour = (225, 105, 40, 255)  # what is forbidden: walls, violations, upper bounds
HATCH: Colour = (225, 105, 40, 110)
ORANGE: Colour = (240, 180, 50, 255)  # the best so far
GREEN: Colour = (30, 190, 140, 255)  # what is proven: lower bounds
PURPLE: Colour = (214, 140, 185, 255)  # the constraints that decide: active indices
INK: Colour = (225, 225, 225, 255)
GREY: Colour = (140, 140, 140, 255)
FAINT: Colour = (90, 90, 90, 255)
GROUND: Colour = (24, 26, 31, 255)
FORBIDDEN: Colour = (120, 52, 20, 255)  # where no decision meets the constraints
TRIED: Colour = (255, 255, 255, 150)  # points that a walk has accepted, or that nobody judged
REFUSED: Colour = (225, 105, 40, 120)  # points that it has refused
PAST: Colour = (255, 255, 255, 90)  # a walk before it was heated again
HALF: Colour = (240, 180, 50, 130)  # the best so far, where it is not on the slice
SKETCH: Colour = (255, 255, 255, 130)  # cells, balls, regions

_VIRIDIS = np.array(
    [
        (68, 1, 84),
        (71, 44, 122),
        (59, 81, 139),
        (44, 113, 142),
        (33, 144, 141),
        (39, 173, 129),
        (92, 200, 99),
        (170, 220, 50),
        (253, 231, 37),
    ],
    dtype=float,
)
_DIVERGING = np.array(
    [(33, 102, 172), (103, 169, 207), (209, 229, 240), (253, 219, 199), (239, 138, 98), (178, 24, 43)], dtype=float
)


LEGIBLE = 0.22
"""Luminance of the lines of a plot whose ground is the theme's: at 0.02 they are lost on a dark one, at 1 on a light
one; here they have a contrast of 4.5 to the one and of 3.9 to the other (WCAG 2.1)."""
BRIGHT = 0.8
"""Luminance of words, which the viewer writes on a veil above our dark ground, a grey one of luminance 0.2 in its light
theme: a tenth of it is lost there, and so is nearly everything below it; there is nothing above 1."""


def _luminance(colour: Floats) -> float:
    return float(np.array([0.2126, 0.7152, 0.0722]) @ (colour / 255.0) ** 2.2)


@cache
def legible(colour: Colour) -> Colour:
    """Return a colour for lines on a ground that may be dark or light: no brighter than `LEGIBLE`."""
    rgb = np.array(colour[:3], dtype=float)
    red, green, blue = np.rint(rgb * min(1.0, LEGIBLE / _luminance(rgb)) ** (1.0 / 2.2)).astype(int).tolist()
    return red, green, blue, colour[3]


@cache
def worded(colour: Colour) -> Colour:
    """Return a colour for words: mixed with so much white that it is `BRIGHT`."""
    rgb = np.array(colour[:3], dtype=float)
    shares = np.linspace(0.0, 1.0, 101)
    share = next(share for share in shares if _luminance(rgb + share * (255.0 - rgb)) >= BRIGHT)
    red, green, blue = np.rint(rgb + share * (255.0 - rgb)).astype(int).tolist()
    return red, green, blue, 255


def sequential(values: Floats) -> npt.NDArray[np.uint8]:
    """Return the Viridis colours ``(..., 4)`` of values ``(...)`` between 0 and 1; NaN is transparent."""
    return _graded(values, _VIRIDIS)


def diverging(values: Floats) -> npt.NDArray[np.uint8]:
    """Return colours, blue below 0 and red above, of values ``(...)`` between -1 and 1; NaN is transparent."""
    return _graded((values + 1.0) / 2.0, _DIVERGING)


def _graded(values: Floats, stops: Floats) -> npt.NDArray[np.uint8]:
    is_finite = np.isfinite(values)
    position = np.clip(np.where(is_finite, values, 0.0), 0.0, 1.0) * (len(stops) - 1)
    below = np.minimum(position.astype(int), len(stops) - 2)
    share = (position - below)[..., np.newaxis]
    rgb = stops[below] * (1.0 - share) + stops[below + 1] * share
    return np.concatenate([rgb, np.where(is_finite, 255.0, 0.0)[..., np.newaxis]], axis=-1).astype(np.uint8)
