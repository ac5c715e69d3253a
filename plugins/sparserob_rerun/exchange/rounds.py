"""The exchange: two bounds that close, the violation of every family along its indices, and the cuts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import Axes, Drawing
from sparserob_rerun.drawing.palette import Floats
from sparserob_rerun.exchange.bounds import Bounds

INSTANTS, PARAMETERS = 97, 15
FAMILIES = 3  # that are drawn: of four plots above one another the words cover one another
LATTICE = 27  # points at most for the coordinates that are not drawn
LEFT, WIDTH, HEIGHT = 60.0, 640.0, 112.0
GAP, NUMBERS = 52.0, 24.0  # between two plots, and as much more where each has the numbers of an axis of its own
LETTER = 10.0  # room of a letter of the name of the axis across, at its end
ROOM = 1.15  # of words, in a panel that is smaller than its drawing
SMALLEST = 1e-12
ACROSS, UPWARDS = 4.0, 16.0  # how large a cell of a map is: about as wide as high, for the numbers of them
WORDS, MARGIN = 70.0, 16.0  # above a map, where it has its name, and around the maps
MAP = UPWARDS * PARAMETERS + WORDS  # from one map to the next
SERIES = {
    "rounds/bounds": {"lower bound (proven)": ink.GREEN, "upper bound": ink.VERMILLION},
    "rounds/log10": {"log10 of the violation": ink.VERMILLION, "log10 of the relative gap": ink.SKY},
    "rounds/counts": {"active indices": ink.PURPLE, "cuts added": ink.ORANGE},
}


def extent(families: int, shared: bool, unit: str = "") -> tuple[float, float, float, float]:
    """Return left, right, top and bottom of the violation plots; ``shared``: over one axis, that of time, in its
    ``unit``."""
    bottom = max(1, min(FAMILIES, families)) * _below(shared) - (GAP if shared else GAP + NUMBERS)
    letters = len(_named(shared, unit)) - 1
    return -42.0, LEFT + WIDTH + 76.0 + LETTER * letters, -40.0, bottom + 60.0


def _named(shared: bool, unit: str) -> str:
    """Return the name of the axis across."""
    return ("t" + (f" in {unit}" if unit else "")) if shared else "index"


def extent_of_maps(maps: int) -> tuple[float, float, float, float]:
    """Return left, right, top and bottom of so many maps above one another."""
    return -MARGIN, ACROSS * INSTANTS + MARGIN, -WORDS, maps * MAP - WORDS + MARGIN


def mapped(program: sr.SemiInfiniteProgram) -> int:
    """Count the families that have a map: those whose first two coordinates both move."""
    boxes = [family.index_set for family in shown_families(program)[:FAMILIES] if family.index_set.dimension > 1]
    return sum(bool((box.upper[:2] > box.lower[:2]).all()) for box in boxes)


def _below(shared: bool) -> float:
    """Return the distance from the top of one plot to the top of the next below it."""
    return HEIGHT + GAP + (0.0 if shared else NUMBERS)


def shown_families(program: sr.SemiInfiniteProgram) -> list[sr.ConstraintFamily]:
    """Return the families that constrain, without those that only say what the cost is."""
    return [family for family in program.families if not family.defines]


@final
@dataclass(frozen=True)
class Worst:
    """Worst violation of a constraint, as far as it is known: its ``value`` and where (``at``), NaN where that is not
    known, and whether it is ``proven`` that nothing counts as violated."""

    value: float
    at: float
    proven: bool = False


@final
class Rounds:
    """Pictures and series of the rounds, below ``/rounds`` and ``/violation``."""

    def __init__(self, rr: Any, stream: Any, inspection: sr.Inspection | None) -> None:
        self.rr, self.stream, self.inspection = rr, stream, inspection
        self.picture = Bounds(rr, stream)
        for path, series in SERIES.items():
            names, colours = list(series), [ink.legible(colour) for colour in series.values()]
            stream.log(
                path,
                rr.SeriesLines(names=names, colors=colours, widths=[2.0] * len(names)),
                rr.SeriesPoints(names=names, colors=colours, marker_sizes=[4.0] * len(names)),
                static=True,
            )

    def bounds(self, event: sr.RoundFinished) -> None:
        """Log the numbers of one round."""
        self.picture.add(event)
        upper = np.inf if event.simplified else event.upper_bound
        rr, shown = self.rr, [value if np.isfinite(value) else np.nan for value in (event.lower_bound, upper)]
        self.stream.log("rounds/bounds", rr.Scalars(shown))
        gap = event.gap if np.isfinite(event.gap) else np.nan
        self.stream.log("rounds/log10", rr.Scalars([_decades(event.violation), _decades(gap)]))
        self.stream.log("rounds/counts", rr.Scalars([float(event.active_indices), float(event.cuts_added)]))

    def violations(
        self, decision: Floats, cuts: Sequence[sr.Cut], added: Sequence[sr.Cut], told: Mapping[str, Worst]
    ) -> None:
        """Draw the violation of every family at a decision over its first index, and over the second as a map.
        ``told``: what a search or a proof reports of the worst violation, which a picture on a grid does not know."""
        if self.inspection is None:
            return
        drawing, families, maps = Drawing(), shown_families(self.inspection.program), 0
        for position, family in enumerate(families[:FAMILIES]):
            across, along, field = violation_field(family, decision)
            last = position == min(len(families), FAMILIES) - 1
            words = self._words(family, told.get(family.name), (across, along, field))
            if last and len(families) > FAMILIES:
                words += f" ({len(families) - FAMILIES} more constraints are not shown)"
            self._plot(drawing, (position, last), family, (across, along, field), (cuts, added), words)
            if along.size > 1 and across.size > 1:
                self._map(maps, family, (across, along, field))
                maps += 1
        drawing.log(self.rr, self.stream, "violation/plots", layers=("hatch", "frame", "marks", "curve"))

    def _words(self, family: sr.ConstraintFamily, known: Worst | None, found: tuple[Floats, Floats, Floats]) -> str:
        """Describe one constraint in words: as search and proof know it, else as the grid shows it."""
        assert self.inspection is not None
        across, _, field = found
        worst = field.max(axis=1)
        if known is None:
            value, at, grid = float(worst.max()), float(across[worst.argmax()]), " on this grid"
        else:
            value, at, grid = known.value, known.at, ""
        where = f" at t = {at:.4g}" if self.inspection.problem is not None and np.isfinite(at) else ""
        proven = known is not None and known.proven
        if value > self.inspection.tolerance(family.name) and not proven:
            return f"{family.name}: violated by {value:.3g}{where}{grid}; above 0 is forbidden"
        margin = f", to within {value:.1e}{where}" if value > 0.0 else f", with {-value:.2g} to spare{where}{grid}"
        return f"{family.name} {'is proven to hold' if proven else 'holds'}" + (margin if np.isfinite(value) else "")

    def _plot(
        self,
        drawing: Drawing,
        where: tuple[int, bool],
        family: sr.ConstraintFamily,
        found: tuple[Floats, Floats, Floats],
        marked: tuple[Sequence[sr.Cut], Sequence[sr.Cut]],
        words: str,
    ) -> None:
        across, _, field = found
        worst, box = field.max(axis=1), family.index_set
        problem = None if self.inspection is None else self.inspection.problem
        ends = (0.0, problem.horizon) if problem is not None else (float(box.lower[0]), float(box.upper[0]))
        if ends[0] == ends[1]:
            ends = (ends[0] - 1.0, ends[1] + 1.0)
        low = float(np.quantile(worst, 0.02))
        reach = max(abs(low), abs(float(worst.max())), 1e-9)
        shared, (position, last) = problem is not None, where
        limits = (-reach, max(0.35 * reach, 1.15 * float(worst.max())))
        axes = Axes(LEFT, position * _below(shared), WIDTH, HEIGHT, ends, limits)
        unit = "" if problem is None else problem.names.time
        drawing.frame(axes, words, _named(shared, unit), last or not shared, room=ROOM)
        drawing.hatched("hatch", axes, axes.x, (0.0, axes.y[1]), ink.HATCH)
        if across.size > 1:
            drawing.line("curve", axes.at(across, worst), ink.SKY, 2.0)
        else:
            drawing.dashed("marks", axes.at(np.full(2, across[0]), np.array(axes.y)), ink.GREY)
            drawing.dot(axes.at(across, worst), ink.SKY, 6.0)
        for cuts, colour, size in zip(marked, (ink.PURPLE, ink.ORANGE), (5.0, 7.0), strict=True):
            times = np.array([cut.index[0] for cut in cuts if cut.family == family.name])
            if times.size:
                drawing.dot(axes.at(times, 0.0), colour, size)

    def _map(self, number: int, family: sr.ConstraintFamily, found: tuple[Floats, Floats, Floats]) -> None:
        """Draw a map of the violation: time from left to right, the first parameter upwards; red is violated."""
        assert self.inspection is not None
        across, along, field = found
        rr, reach, top = self.rr, max(float(np.abs(field).max()), SMALLEST), number * MAP
        image = np.ascontiguousarray(ink.diverging(np.flipud(field.T) / reach)[:, :, :3])
        path = f"violation/maps/{family.name.replace('[', '_').replace(']', '')}"
        self.stream.log(
            path, rr.Transform3D(translation=(0.0, top, 0.0), scale=(ACROSS, UPWARDS, 1.0)), rr.Image(image)
        )
        first_name, second_name = self.inspection.names(family.index_set.dimension)[:2]
        words = (
            f"{family.name}: {first_name} from {across[0]:.4g} to {across[-1]:.4g}, "
            f"upwards {second_name} from {along[0]:.4g} to {along[-1]:.4g}"
        )
        self.stream.log(
            f"violation/names/{number}",
            rr.Points2D(
                [(ACROSS * INSTANTS / 2.0, top - 20.0)],
                labels=[words],
                colors=[ink.INK],
                radii=rr.Radius.ui_points(0.0),
                show_labels=True,
            ),
        )


def told_by_round(event: sr.RoundFinished) -> dict[str, Worst]:
    """Return the worst violations that the searches of a round found, by family."""
    return {
        name: Worst(float(separation.violations[0]), float(separation.indices[0, 0]))
        for name, separation in event.separations.items()
        if separation.violations.size and separation.indices.size
    }


def told_by_result(result: sr.Result) -> dict[str, Worst]:
    """Return what a result reports by family: what its proofs exclude, and the worst constraint that it names."""
    by_family = {proof.family: Worst(np.nan, np.nan, True) for proof in result.proofs if proof.verdict == "proven"}
    worst = result.worst
    if worst is not None and worst.constraint:
        time = worst.time if isinstance(worst, sr.Witness) else worst.index[0] if worst.index.size else None
        proven = worst.constraint in by_family
        by_family[worst.constraint] = Worst(worst.violation, np.nan if time is None else float(time), proven)
    return by_family


def violation_field(family: sr.ConstraintFamily, decision: Floats) -> tuple[Floats, Floats, Floats]:
    """Return values of the first index coordinate ``(k,)`` and of the second ``(l,)``, and the largest violation
    ``(k, l)`` of all rows there, over a coarse lattice of the other coordinates. The field is a picture, not a
    proof."""
    box = family.index_set
    across = np.linspace(box.lower[0], box.upper[0], INSTANTS if box.upper[0] > box.lower[0] else 1)
    has_second = box.dimension > 1 and box.upper[1] > box.lower[1]
    along = (
        np.linspace(box.lower[1], box.upper[1], PARAMETERS)
        if has_second
        else np.array(box.lower[1:2] if box.dimension > 1 else [0.0])
    )
    lattice = _lattice(box.lower[2:], box.upper[2:])
    field = np.full((across.size, along.size), -np.inf)
    for point in lattice:
        grid = np.array([[a, *([b] if box.dimension > 1 else []), *point] for a, b in product(across, along)])
        field = np.maximum(field, family.violations(decision, grid).max(axis=1).reshape(field.shape))
    return across, along, field


def _lattice(lower: Floats, upper: Floats) -> list[Floats]:
    """Return the corners and the middle of a box, or its middle alone where the corners are too many."""
    middle = (lower + upper) / 2
    if 2**lower.size > LATTICE:
        return [middle]
    corners = [np.array(corner) for corner in product(*zip(lower, upper, strict=True))]
    return [middle, *corners] if lower.size else [middle]


def _decades(value: float) -> float:
    return float(np.log10(max(value, SMALLEST))) if np.isfinite(value) else np.nan
