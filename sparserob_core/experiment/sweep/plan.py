"""The plan of a study: a base config, the changes of it for all points, and the axes; and its file."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, final

import numpy as np

from sparserob_core.arguments import is_whole
from sparserob_core.encodings import name_of, path_of
from sparserob_core.errors import ConfigError, InputError
from sparserob_core.experiment.config.extending import extended, movable
from sparserob_core.experiment.config.load import Loaded, load_config
from sparserob_core.experiment.config.plain import IRRELEVANT, difference, identity, value_text
from sparserob_core.experiment.config.reading.overrides import parse_overrides
from sparserob_core.experiment.config.reading.reader import ConfigSource, read_source, read_value, write_yaml
from sparserob_core.experiment.plugins.messages import nearest, shown
from sparserob_core.experiment.run.events import StudyProgress
from sparserob_core.experiment.sweep.axes import FIXED, MAX_STUDY_POINTS, Axis, parse_axes, require_whole
from sparserob_core.sip.events import Notify, ignore

FILE = "sweep.yaml"
HEADING = "A study. To go on with it, or to repeat it elsewhere: sparserob sweep sweep.yaml --out DIRECTORY"
KEYS = ("base", "overrides", "axes", "points", "number", "seed")
CONFIGS_PER_REPORT = 100  # number of configs between two reports of their check
Arrangement = Literal["grid", "zip", "random", "sobol"]
ARRANGEMENTS: tuple[Arrangement, ...] = ("grid", "zip", "random", "sobol")


@final
@dataclass(frozen=True)
class Point:
    """A point of a study: a value for every axis, its checked config, and the ``hash`` of all that decides its result.

    The config is kept as JSON, since there may be very many points.
    """

    values: tuple[Any, ...]
    resolved: str
    hash: str

    @property
    def config(self) -> dict[str, Any]:
        """The complete, resolved config, as mappings, lists, numbers and text."""
        config: dict[str, Any] = json.loads(self.resolved)
        return config


@final
@dataclass(frozen=True, eq=False)
class Plan:
    """A study before anything is run.

    Parameters
    ----------
    base : ConfigSource
        The base config.
    changes : tuple of Axis
        The changes of the base, in their order. One with several values is an axis; one with a single value holds for
        all points.
    points : {"grid", "zip", "random", "sobol"}, default "grid"
        The choice of the points: all combinations of values; the first values together, then the second, and so on; or
        points that are drawn at random or along a sequence of Sobol.
    number, seed : int, optional
        The number of points that are drawn, and the seed.
    file : str, default ""
        The study's own file, where it has one.
    """

    base: ConfigSource
    changes: tuple[Axis, ...]
    points: Arrangement = "grid"
    number: int | None = None
    seed: int | None = None
    file: str = ""

    @property
    def name(self) -> str:
        """The name of the base config: that of its file, without the ending."""
        return Path(self.base.name).stem

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The changes with several values."""
        return tuple(axis for axis in self.changes if not axis.single)

    def loaded(self, values: Sequence[Any]) -> Loaded:
        """Return the checked config of a point."""
        remaining_values = iter(values)
        changes = {axis.key: axis.values[0] if axis.single else next(remaining_values) for axis in self.changes}
        return load_config(self.base, changes)

    def values(self) -> list[tuple[Any, ...]]:
        """Return the values of every point in the order of the table: the last axis changes first.

        Raises `InputError` where the axes do not fit the arrangement, or have too many combinations.
        """
        if self.points in ("random", "sobol"):
            return self._draw_points()
        for axis in self.axes:
            if axis.span is not None:
                raise InputError(
                    path=axis.key,
                    expected="start:stop:count, or a number of points to draw (--random N, --sobol N)",
                    got=shown(axis.written),
                )
        if self.points == "zip":
            counts = {axis.key: len(axis.values) for axis in self.axes}
            if len(set(counts.values())) > 1:
                counts_text = ", ".join(f"{count} of {key}" for key, count in counts.items())
                raise InputError(path="zip", expected="axes with equally many values", got=counts_text)
            return list(zip(*(axis.values for axis in self.axes), strict=True)) if self.axes else [()]
        places = list(product(*(range(len(axis.values)) for axis in self._list_leading_axes(MAX_STUDY_POINTS))))
        return [self._get_values(row) for row in places]

    def _list_leading_axes(self, max_points: float = np.inf) -> list[Axis]:
        """Return the axes without those that follow another one; raises `InputError` for more than
        ``max_points`` combinations."""
        leading = [axis for axis in self.axes if not axis.follows]
        count = int(np.prod([len(axis.values) for axis in leading], dtype=float))
        if count > max_points:
            raise InputError(path="axes", expected=f"at most {MAX_STUDY_POINTS} points", got=str(count))
        return leading

    def _get_values(self, places: Sequence[int]) -> tuple[Any, ...]:
        """Return the values of all axes, where the leading ones are at these ``places``."""
        index_of_key = dict(zip((axis.key for axis in self._list_leading_axes()), places, strict=True))
        return tuple(axis.values[index_of_key[axis.paired[0] if axis.paired else axis.key]] for axis in self.axes)

    def _draw_points(self) -> list[tuple[Any, ...]]:
        leading = self._list_leading_axes()
        count, dimension = int(self.number or 0), len(leading)
        if not any(axis.span for axis in self.axes):
            expected = "at least one range to draw from, such as key=0.01:0.06"
            raise InputError(
                path=self.points, expected=expected, got="lists of values only" if self.axes else "no axis"
            )
        rng = np.random.default_rng(self.seed)
        if self.points == "random":
            shares = rng.random((count, dimension))
        else:
            shares = _draw_sobol(dimension, count, rng)
        columns = {axis.key: column for axis, column in zip(leading, shares.T.tolist(), strict=True)}
        drawn = []
        for axis in self.axes:
            column = columns[axis.paired[0] if axis.paired else axis.key]
            drawn.append([axis.span.at(s) if axis.span else axis.values[int(s * len(axis.values))] for s in column])
        return list(zip(*drawn, strict=True))

    def checked(self, notify: Notify = ignore) -> list[Point]:
        """Return every point with its checked config.

        ``notify`` receives `StudyProgress`. Raises `ConfigError` for the first point that is at fault.
        """
        points = []
        try:
            rows = self.values()
        except InputError as error:
            raise (ConfigError(f"{self.file}: {error}") if self.file else error) from None
        for values in rows:
            plain = self.loaded(values).config.plain()
            points.append(Point(values, json.dumps(plain), identity(plain)))
            if len(points) % CONFIGS_PER_REPORT == 0:
                text = f"{len(points)} of {len(rows)} configs are checked"
                notify(StudyProgress(text=text, done=len(points), total=len(rows)))
        return points

    def written(self) -> str:
        """Return the contents of ``sweep.yaml``."""
        axes: dict[str, Any] = {}
        for axis in self.changes:
            if not axis.paired:
                axes[axis.key] = _write_axis(axis)
            elif not axis.follows:
                group = [next(change for change in self.changes if change.key == key) for key in axis.paired]
                axes[",".join(axis.paired)] = [
                    list(row) for row in zip(*(change.values for change in group), strict=True)
                ]
        data: dict[str, Any] = {"base": self.base.data, "axes": axes, "points": self.points}
        if self.number is not None:
            data |= {"number": self.number, "seed": self.seed}
        return write_yaml(data, HEADING)

    def apart_from(self, other: Plan) -> str:
        """Return the difference of the base from another study's in what decides results; empty where there is none."""
        own_base, other_base = (
            {key: value for key, value in plan.base.data.items() if key not in IRRELEVANT} for plan in (self, other)
        )
        mismatch = difference(own_base, other_base)
        return (
            ""
            if mismatch is None
            else f"{mismatch[0]} is {value_text(mismatch[2])} there and {value_text(mismatch[1])} here"
        )


def make_plan(
    config: str | Path | Mapping[str, Any] | ConfigSource,
    axes: Mapping[str, object] | Sequence[str] | None = None,
    overrides: Mapping[str, object] | Iterable[str] | None = None,
    *,
    points: Arrangement | None = None,
    number: int | None = None,
) -> Plan:
    """Return the study of a config, or of a study's own file.

    Parameters
    ----------
    config : str, Path, mapping or Source
        The config, or the file of a study.
    axes : mapping or sequence of str, optional
        Further axes, which replace those with the same key.
    overrides : mapping or iterable of str, optional
        Changes for all points.
    points : {"grid", "zip", "random", "sobol"}, optional
        The choice of the points.
    number : int, optional
        The number of points that are drawn.

    Returns
    -------
    Plan
        The study.

    Raises
    ------
    InputError
        If an argument is at fault.
    """
    source = read_source(config)
    plan = _parse_plan(source) if {"base", "axes"} & set(source.data) else Plan(_resolve_base(source), ())
    kept = list(plan.changes)
    changes = _parse_changes(overrides)
    new_axes = parse_axes(list(axes) if isinstance(axes, Iterable) and not isinstance(axes, str | Mapping) else axes)
    for path in {change.path for change in changes} & {axis.path for axis in new_axes}:
        raise InputError(path=path, expected="an axis or an override", got="both")
    for axis in new_axes:
        index = next((k for k, kept_change in enumerate(kept) if kept_change.path == axis.path), len(kept))
        kept[index : index + 1] = [axis]
    for change in reversed(changes):
        kept = [change, *(kept_change for kept_change in kept if kept_change.path != change.path)]
    require_whole(kept)
    plan = replace(
        plan,
        changes=tuple(map(_resolve_files, kept)),
        points=points or plan.points,
        number=number if points else plan.number,
    )
    drawn = plan.points in ("random", "sobol")
    return replace(plan, seed=_find_seed(plan)) if drawn and plan.seed is None else plan


def _parse_changes(overrides: Mapping[str, object] | Iterable[str] | None) -> list[Axis]:
    """Return overrides as changes with a single value each, lists and texts with commas included."""
    parsed_overrides = parse_overrides(overrides, read_value)
    return [Axis(".".join(map(str, override.path)), (override.value,), override.value) for override in parsed_overrides]


def _write_axis(axis: Axis) -> object:
    """Return an axis as it stands in ``sweep.yaml``.

    A single value is a list of one, unless its key is never an axis.
    """
    return [axis.values[0]] if axis.single and axis.path[0] not in FIXED else axis.written


def read_plan(file: Path) -> Plan:
    """Return the study in a ``sweep.yaml``; raises `InputError` where it is none."""
    source = read_source(file)
    if not {"base", "axes"} & set(source.data):
        raise ConfigError(f"{file}: expected a study, with the keys base and axes, got {', '.join(source.data)}")
    return make_plan(file)


def _parse_plan(source: ConfigSource) -> Plan:
    """Return the study in a file, with its keys checked."""
    data = source.data
    for key in data:
        if key not in KEYS:
            raise _make_error(source, key, f"unknown key{nearest(str(key), KEYS)}")
    base = data.get("base")
    if not isinstance(base, str | Mapping) or not base:
        raise _make_error(source, "base", f"must be a config, or the name of its file (got {shown(base)})")
    for key in ("axes", "overrides"):
        if not isinstance(data.get(key, {}), Mapping):
            raise _make_error(
                source, key, f"must be a mapping of keys of the config to values (got {shown(data[key])})"
            )
    points, number, seed = _parse_arrangement(source)
    try:
        changes = [*_parse_changes(data.get("overrides")), *parse_axes(data.get("axes"))]
    except InputError as error:
        raise ConfigError(f"{source.where(('axes', *error.path))}: {error}") from None
    below = (
        read_source(source.folder / path_of(base))
        if isinstance(base, str)
        else replace(source, data=dict(base), text="")
    )
    return Plan(_resolve_base(below), tuple(changes), points, number, seed, source.name)


def _parse_arrangement(source: ConfigSource) -> tuple[Arrangement, int | None, int | None]:
    """Return how the points of a study's file are chosen, how many are drawn, and with which seed."""
    points = source.data.get("points", "grid")
    if points not in ARRANGEMENTS:
        raise _make_error(source, "points", f"must be one of {', '.join(ARRANGEMENTS)} (got {shown(points)})")
    drawn = points in ("random", "sobol")
    numbers = list[int | None]()
    for key, least in (("number", 1), ("seed", 0)):
        value = source.data.get(key)
        if value is not None and not drawn:
            raise _make_error(source, key, f"is for points that are drawn (random, sobol), not for {points}")
        if (value is not None or (drawn and key == "number")) and not is_whole(value, least):
            raise _make_error(source, key, f"must be a whole number of at least {least} (got {shown(value)})")
        numbers.append(value)
    return points, numbers[0], numbers[1]


def _make_error(source: ConfigSource, key: str, said: str) -> ConfigError:
    return ConfigError(f"{source.where((key,))}: {key}: {said}")


def _resolve_base(source: ConfigSource) -> ConfigSource:
    """Return the base of a study in a form that holds in any folder.

    Files of plugins have their absolute names, the numbers of matrices replace their files, and its own name is the
    title where it has none.
    """
    source = extended(source)
    data, _ = movable(source)  # errors of matrices are reported where a config is checked
    if not data.get("title"):
        data["title"] = Path(source.name).stem
    return replace(source, data=data)


def _resolve_files(axis: Axis) -> Axis:
    if axis.path != ("plugins",) or not isinstance(axis.values[0], list):
        return axis
    files = [name_of(path_of(str(file)).resolve()) for file in axis.values[0]]
    return replace(axis, values=(files,), written=files)


def _find_seed(plan: Plan) -> int:
    """Return the seed of the base config, with which points are drawn."""
    fixed = (axis.values[0] for axis in plan.changes if axis.single and axis.path == ("seed",))
    changed = next(fixed, plan.base.data.get("seed", 0))
    return changed if is_whole(changed, 0) else 0


def _draw_sobol(dimension: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return the first points ``(count, dimension)`` of a scrambled sequence; a larger number begins with the same
    points."""
    from scipy.stats import qmc

    # scipy renamed the argument in 1.15
    seeded: dict[str, Any] = {"rng" if "rng" in inspect.signature(qmc.Sobol).parameters else "seed": rng}
    sequence = qmc.Sobol(dimension, scramble=True, **seeded)
    drawn: np.ndarray = sequence.random_base2(max(0, (count - 1).bit_length()))[:count]
    return drawn
