"""The run of a study: finished points are taken as they are, the others go to the executor, and the table grows."""

from __future__ import annotations

import os
import platform
import re
import shutil
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, final

from sparserob_core.arguments import is_whole
from sparserob_core.errors import InputError, SparseRobError, named
from sparserob_core.experiment.assemble import build
from sparserob_core.experiment.config.load import load_config
from sparserob_core.experiment.config.plain import value_text
from sparserob_core.experiment.directory.artefacts import RunDirectory, create_directory, finite, share_directory
from sparserob_core.experiment.directory.finished import UNFINISHED, read_summary
from sparserob_core.experiment.directory.lock import is_dead, is_free
from sparserob_core.experiment.directory.provenance import git_revision
from sparserob_core.experiment.run.events import (
    Broadcast,
    Observer,
    PointProgress,
    SweepFinished,
    SweepProgress,
    SweepStarted,
)
from sparserob_core.experiment.run.given import GivenConfig, as_config
from sparserob_core.experiment.sweep.axes import Axis
from sparserob_core.experiment.sweep.plan import FILE, Arrangement, Plan, Point, make_plan, read_plan
from sparserob_core.experiment.sweep.point import Bounds, PointAnswer, Task, run_point
from sparserob_core.experiment.sweep.study import RUNS, Study
from sparserob_core.experiment.sweep.table import COLUMNS, TABLE, Row, columns_of, columns_text, row_of, table_text
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.method import ExecutorFactory

PAUSE = 0.5  # seconds between two reports of the points that run
SECONDS_PER_TABLE = 2.0  # seconds between two versions of the table
STILLBORN = 3  # number of consecutive executors whose workers may die before they begin a point
MAX_RUN_NAME_LETTERS = 60  # letters of the name of a run directory, before its hash
HASH_DIGITS = 12  # digits of the hash in that name
PARTIAL = ".partial"
PARTIAL_OWNER = re.compile(rf"-[0-9a-f]{{{HASH_DIGITS}}}\.(.*)\.(\d+){re.escape(PARTIAL)}")
"""End of the name of a run that is not over: the host and the process that began it."""


@final
@dataclass(frozen=True, eq=False)
class Outline:
    """A study before it is run.

    Parameters
    ----------
    plan : Plan
        The study.
    points : sequence of Point
        All of its points.
    names : mapping
        The name of the run directory, by the hash of the point.
    left : frozenset of str
        The hashes of the points that are not finished.
    """

    plan: Plan
    points: Sequence[Point]
    names: Mapping[str, str]
    left: frozenset[str]

    def summary(self) -> dict[str, Any]:
        """Return the study as plain data."""
        keys = [axis.key for axis in self.plan.axes]
        return {
            "title": str(self.plan.base.data["title"]),
            "axes": keys,
            "points": [
                {
                    "point": number,
                    "values": dict(zip(keys, point.values, strict=True)),
                    "finished": point.hash not in self.left,
                    "run": self.names[point.hash],
                    "hash": point.hash,
                }
                for number, point in enumerate(self.points)
            ],
        }

    def shown(self) -> tuple[list[str], list[list[str]]]:
        """Return the points for a terminal: names of the columns, and one row per point."""
        keys = [axis.key for axis in self.plan.axes]
        rows = [
            [
                str(number),
                *map(value_text, point.values),
                "to run" if point.hash in self.left else "finished",
                self.names[point.hash],
            ]
            for number, point in enumerate(self.points)
        ]
        return ["point", *keys, "state", "run"], rows


def sweep(
    config: GivenConfig,
    axes: Mapping[str, object] | Sequence[str] | None = None,
    overrides: Mapping[str, object] | Iterable[str] | None = None,
    *,
    points: Arrangement | None = None,
    number: int | None = None,
    point: int | None = None,
    executor: str | Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    figures: bool = False,
    notify: Notify = ignore,
    observers: Iterable[Observer] = (),
) -> Study:
    """Run a config at every point of some axes, as ``sparserob sweep CONFIG key=a,b,c key=start:stop:count`` does.

    A study of the same base in the directory ``out`` is continued. Points that are finished there, by the hash of their
    config, are not run again; points that failed or ended at a time limit are. A point that fails gives a row with the
    reason. An interrupt ends the runs that are going on, and the study has the rows that are known by then.

    Parameters
    ----------
    config : str, Path, mapping, OptimalControlProblem or finished run
        A config or a problem (`as_config`), a study's own file (``sweep.yaml``), or the directory of a study that is
        continued.
    axes : mapping or sequence of str, optional
        The axes: a mapping of keys to lists of values, or to texts such as ``"0:19:20"`` or ``"log:1e-6:1:13"``; or
        texts ``key=values``.
    overrides : mapping or iterable of str, optional
        Changes of the config for all points.
    points : {"grid", "zip", "random", "sobol"}, optional
        The choice of the points: all combinations (``grid``, the default), ``zip``, or ``number`` points at ``random``
        or along a sequence of ``sobol``.
    number : int, optional
        The number of points that are drawn.
    point : int, optional
        The only point that is run, by its number from 0 in the order of the table. It is run here, without an executor,
        into the directory ``out``, which any number of processes may fill at once. None of them writes the table, which
        is written when the study is continued. A study that is there must be equal to this one in every value.
    executor : str or mapping, optional
        The executor; that of the config unless given. The runs themselves are serial, and no result depends on it.
    out : str or Path, optional
        The directory of the study; ``runs/NAME-sweep/STAMP-HASH`` unless given.
    figures : bool, default False
        Whether the figures of every run are drawn.
    notify : callable, optional
        A function that receives `SweepProgress`.
    observers : iterable of Observer, default ()
        Observers of the study, from `SweepStarted` to `SweepFinished`. One that raises an exception is detached with a
        warning, and the study goes on.

    Returns
    -------
    Study
        The study with its table.

    Raises
    ------
    InputError
        If an axis, a point's config or the directory is at fault. It is raised before anything is run.
    """
    source, out = _resolve_study(config, out)
    plan = make_plan(as_config(source), axes, overrides, points=points, number=_check_number(points, number))
    if point is not None:
        _check_single_point(out, executor)
    checked = plan.checked(notify)
    factory = _build_executors(checked[0], executor if point is None else "serial")
    if point is not None:
        checked = [_find_point(checked, point)]
    broadcast = Broadcast([(type(observer).__name__, observer) for observer in observers])
    sweep_call = None
    try:
        if point is not None and out is not None:
            study_directory = share_directory(out, FILE, plan.written())
            _require_same_study(study_directory.path, plan)
            sweep_call = _SweepCall(plan, checked, study_directory, figures, notify, broadcast, alone=True)
            return sweep_call.run(factory)
        with create_directory(out, f"{plan.name}-sweep", checked[0].hash[:8], again=FILE) as study_directory:
            _require_same_base(study_directory.path, plan)
            study_directory.write_text(FILE, plan.written())
            sweep_call = _SweepCall(plan, checked, study_directory, figures, notify, broadcast)
            return _draw_figure(sweep_call.run(factory))
    except BaseException as error:
        if sweep_call is not None:
            sweep_call.stopped = sweep_call.stopped or named(error)
        raise
    finally:
        if sweep_call is not None:
            with suppress(KeyboardInterrupt):  # an interrupt ends the observers: the study is over
                broadcast(sweep_call.ending())  # the lock is released before, since a page may be served for hours


def outline(
    config: GivenConfig,
    axes: Mapping[str, object] | Sequence[str] | None = None,
    *,
    points: Arrangement | None = None,
    number: int | None = None,
    executor: str | Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    notify: Notify = ignore,
) -> Outline:
    """Return the points that `sweep` would run with the same arguments; nothing is written.

    Parameters
    ----------
    config, axes, points, number, executor, out, notify
        As for `sweep`.

    Returns
    -------
    Outline
        The points, with those that are not finished in the directory ``out``.

    Raises
    ------
    InputError
        If an axis, a point's config or the directory is at fault.
    """
    source, out = _resolve_study(config, out)
    plan = make_plan(as_config(source), axes, points=points, number=_check_number(points, number))
    checked = plan.checked(notify)
    _build_executors(checked[0], executor)
    directory = None if out is None else Path(out)
    if directory is not None:
        _require_same_base(directory, plan)
    sweep_call = _SweepCall(plan, checked, RunDirectory(directory or Path()), False, notify, Broadcast([]))
    unfinished = sweep_call.left() if directory is not None else sweep_call.by_hash
    return Outline(plan, checked, sweep_call.names, frozenset(unfinished))


def _resolve_study(config: GivenConfig, out: str | Path | None) -> tuple[GivenConfig, str | Path | None]:
    """Return the config and the directory of a study; of a study's directory its own file, and that directory."""
    if not isinstance(config, str | Path) or not Path(config).is_dir():
        return config, out
    directory = Path(config)
    if not (directory / FILE).is_file():
        raise InputError(f"{directory}: expected the directory of a study, got one without {FILE}")
    return directory / FILE, directory if out is None else out


def _check_single_point(out: str | Path | None, executor: str | Mapping[str, Any] | None) -> None:
    """Raise `InputError` for arguments that exclude the number of a point."""
    if out is None:
        raise InputError(path="point", expected="the directory of the study beside it (out)", got="none")
    if executor is not None:
        raise InputError(path="executor", expected="none beside a point, which is run here", got=repr(executor))


def _find_point(points: Sequence[Point], number: int) -> Point:
    """Return a point by its number; of equal configs it is the first one, which names the run."""
    if not is_whole(number, 0) or number >= len(points):
        raise InputError(path="point", expected=f"a whole number from 0 to {len(points) - 1}", got=repr(number))
    return next(point for point in points if point.hash == points[number].hash)


def _check_number(points: Arrangement | None, number: int | None) -> int | None:
    drawn = points in ("random", "sobol")
    if points not in (None, "grid", "zip", "random", "sobol"):
        raise InputError(path="points", expected="grid, zip, random or sobol", got=repr(points))
    if number is None and not drawn:
        return None
    if not drawn or number is None or not is_whole(number, 1):
        raise InputError(
            path="number", expected="how many points to draw, with points random or sobol alone", got=repr(number)
        )
    return number


def _build_executors(point: Point, chosen: str | Mapping[str, Any] | None) -> ExecutorFactory:
    loaded = load_config(point.config, None if chosen is None else {"executor": chosen})
    factory: ExecutorFactory = build(loaded, "executor", loaded.config.executor)
    return factory


def _require_same_base(directory: Path, plan: Plan) -> None:
    if (directory / FILE).is_file():
        mismatch = plan.apart_from(read_plan(directory / FILE))
        if mismatch:
            raise InputError(
                f"{directory}: holds a study of another base config ({mismatch}); "
                "expected another directory, or that base"
            )


def _require_same_study(directory: Path, plan: Plan) -> None:
    """Raise `InputError` where the study in the directory is another one, in which the number would be another
    point."""
    _require_same_base(directory, plan)
    stored_axes, own_axes = (
        {axis.key: axis for axis in compared_plan.changes} for compared_plan in (read_plan(directory / FILE), plan)
    )
    if read_plan(directory / FILE).written() != plan.written():
        raise InputError(
            f"{directory / FILE}: expected the same study, got {_format_axes(stored_axes)} there and "
            f"{_format_axes(own_axes)} here, or another title or arrangement; "
            "a point of what stands there: --resume DIR --point N"
        )


def _format_axes(changes: Mapping[str, Axis]) -> str:
    return " ".join(f"{key}={value_text(axis.written)}" for key, axis in changes.items()) or "no axes"


@final
class _SweepCall:
    """A call of `sweep`: the points by their hash, and the answers that are known.

    ``alone`` means a single point, while other processes may run others: the table is then not written.
    """

    def __init__(
        self,
        plan: Plan,
        points: Sequence[Point],
        made: RunDirectory,
        figures: bool,
        notify: Notify,
        broadcast: Broadcast,
        alone: bool = False,
    ) -> None:
        self.alone = alone
        self.plan, self.points, self.made, self.figures, self.notify = plan, points, made, figures, notify
        self.broadcast, self.parallel, self.stopped, self.pressed = broadcast, True, "", False
        self.places: dict[str, list[int]] = {}
        for index, point in enumerate(points):
            self.places.setdefault(point.hash, []).append(index)
        self.directory = made.path.resolve()
        self.git = git_revision(plan.base.folder)
        self.by_hash = {point.hash: point for point in reversed(points)}  # the first of equal configs names the run
        self.names = {point.hash: run_name(plan.axes, point) for point in self.by_hash.values()}
        self.copies = Counter(point.hash for point in points)
        self.answers: dict[str, PointAnswer] = {}
        self.pending: set[str] = set()
        self.done = self.failed = self.new = 0
        self.start_time = time.monotonic()
        self.due = self.start_time

    def run(self, factory: ExecutorFactory) -> Study:
        """Run every point that is not finished, and write the table."""
        self._remove_partial_runs()
        waiting = self.left()
        self.pending = set(waiting)
        self.done = sum(self.copies[digest] for digest in self.answers if digest not in self.pending)
        self._write_table()
        self.parallel = factory.parallel
        try:
            self.broadcast(self._make_start_event())
            self._report_progress("")
            self._run_points(factory, waiting)
        except KeyboardInterrupt as pressed:
            self.stopped, self.pressed = str(pressed) or "interrupted from the keyboard", True
        finally:
            self._remove_partial_runs()
            self._read_answers(sorted(self.pending))  # runs that are over, whose workers could not report it any more
            self._write_table()
        return Study(
            directory=self.made.path,
            title=str(self.plan.base.data["title"]),
            axes=self.plan.axes,
            table=self._list_rows(),
            points=len(self.points),
            arrangement=self.plan.points,
            stopped=self.stopped,
        )

    def _make_start_event(self) -> SweepStarted:
        return SweepStarted(
            title=str(self.plan.base.data["title"]),
            directory=self.directory,
            axes=[axis.key for axis in self.plan.axes],
            logarithmic=[axis.log for axis in self.plan.axes],
            points=[point.values for point in self.points],
            arrangement=self.plan.points,
            rows=self._list_known_rows(self.pending),
            parallel=self.parallel,
            runs=self.directory / RUNS,
        )

    def ending(self) -> SweepFinished:
        """Return the last event for observers of the study."""
        return SweepFinished(
            rows=self._list_known_rows(),
            seconds=time.monotonic() - self.start_time,
            stopped=self.stopped,
            pressed=self.pressed,
        )

    def _list_known_rows(self, but: Collection[str] = ()) -> dict[int, Row]:
        """Return the rows that are known, by the places of their points, without the hashes ``but``."""
        digests = [digest for digest in self.answers if digest not in but and digest in self.places]
        return {index: self._make_row(self.points[index]) for digest in digests for index in self.places[digest]}

    def left(self) -> list[str]:
        """Return the hashes of the points that must be run; the answers of the others are read."""
        self._read_answers(dict.fromkeys(point.hash for point in self.points))
        unfinished = []
        for digest in dict.fromkeys(point.hash for point in self.points):
            summary = self.answers[digest].summary if digest in self.answers else None
            if summary is None or summary["status"] == "failed" or summary.get("stopped"):
                unfinished.append(digest)
        return unfinished

    def _read_answers(self, digests: Iterable[str]) -> None:
        """Read the answers of these points from the directory."""
        names_by_digest = {name.rpartition("-")[2]: name for name in _list_directories(self.directory / RUNS)}
        for digest in digests:
            name = names_by_digest.get(digest[:HASH_DIGITS])
            summary = None if name is None else _read_result(self.directory / RUNS / name, digest)
            if name is not None and summary is not None:
                self.names[digest], self.answers[digest] = name, PointAnswer(summary)

    def _run_points(self, factory: ExecutorFactory, waiting: list[str]) -> None:
        """Run points until each has an answer.

        Where a worker dies, its executor is replaced, and the points that had begun are tried again one by one. Only a
        point whose worker dies again fails.
        """
        suspects, stillborn = list[str](), 0
        while waiting or suspects:
            if suspects:
                digest = suspects.pop(0)
                if self._run_batch(factory, [digest]):
                    self._record_answer(digest, PointAnswer(failure="the process that ran it died, twice"))
                continue
            unanswered, before = self._run_batch(factory, waiting), len(waiting)
            suspects = [digest for digest in unanswered if self._get_partial_path(digest).exists()]
            waiting = [digest for digest in unanswered if digest not in set(suspects)]
            stillborn = stillborn + 1 if len(waiting) == before else 0
            if stillborn >= STILLBORN:
                raise SparseRobError("the executor's workers die before they begin a point; is there memory for them?")

    def _run_batch(self, factory: ExecutorFactory, batch: list[str]) -> list[str]:
        """Run a batch on a new executor; returns the points that have no answer since a worker died."""
        unanswered: list[str] = []
        with _open_workers(factory) as executor:
            ended: SimpleQueue[Future[PointAnswer]] = SimpleQueue()
            open_ones: dict[Future[PointAnswer], str] = {}
            for digest in batch:
                shutil.rmtree(self._get_partial_path(digest), ignore_errors=True)
                try:
                    future = executor.submit(run_point, self._make_task(digest), self._make_observers(digest))
                except BrokenExecutor:
                    unanswered.append(digest)
                    continue
                open_ones[future] = digest
                future.add_done_callback(ended.put)
                while not ended.empty():
                    self._collect_answer(ended.get(), open_ones, unanswered)
            while open_ones:
                try:
                    self._collect_answer(ended.get(timeout=PAUSE), open_ones, unanswered)
                except Empty:
                    self._report_progress("", open_ones)
        return unanswered

    def _make_observers(self, digest: str) -> list[Observer]:
        """Return the observer of a point's run: one that reports its bounds, where the run is in this process and
        observed."""
        if self.parallel or not self.broadcast.heard:
            return []
        index = self.places[digest][0]

        def tell(number: int, lower: float, upper: float) -> None:
            seconds = time.monotonic() - self.start_time
            self.broadcast(
                PointProgress(point=index, round=number, lower_bound=lower, upper_bound=upper, seconds=seconds)
            )

        return [Bounds(tell)]

    def _collect_answer(
        self, future: Future[PointAnswer], open_ones: dict[Future[PointAnswer], str], interrupted: list[str]
    ) -> None:
        digest = open_ones.pop(future)
        try:
            answer = future.result()
        except (BrokenExecutor, CancelledError):
            interrupted.append(digest)
            return
        except Exception as error:  # noqa: BLE001  what the executor could not send or fetch is this point's failure
            answer = PointAnswer(failure=named(error))
        self._record_answer(digest, answer, open_ones)
        if answer.interrupted:
            raise KeyboardInterrupt

    def _record_answer(
        self, digest: str, answer: PointAnswer, open_ones: Mapping[Future[PointAnswer], str] | None = None
    ) -> None:
        """Keep an answer, and report it."""
        self.answers[digest] = answer
        self.pending.discard(digest)
        self.new += 1
        self.done += self.copies[digest]
        self.failed += answer.failed
        self._report_progress(digest, open_ones)
        if time.monotonic() >= self.due:
            self._write_table()

    def _make_task(self, digest: str) -> Task:
        return Task(
            config={**self.by_hash[digest].config, "executor": {"name": "serial"}},
            partial=str(self._get_partial_path(digest)),
            final=str(self.directory / RUNS / self.names[digest]),
            git=self.git,
            figures=self.figures,
        )

    def _get_partial_path(self, digest: str) -> Path:
        return self.directory / RUNS / f".{self.names[digest]}.{platform.node()}.{os.getpid()}{PARTIAL}"

    def _list_rows(self) -> list[Row]:
        rows = [self._make_row(point) for point in self.points if point.hash in self.answers]
        names = columns_of([axis.key for axis in self.plan.axes], rows)
        return [{name: row.get(name) for name in names} for row in rows]

    def _make_row(self, point: Point) -> Row:
        answer = self.answers[point.hash]
        values = dict(zip((axis.key for axis in self.plan.axes), point.values, strict=True))
        return row_of(values, answer.summary, self.names[point.hash], point.hash, answer.failure)

    def _write_table(self) -> None:
        """Write the table as it is known now."""
        if self.alone:
            return
        start_time, keys, rows = time.monotonic(), [axis.key for axis in self.plan.axes], self._list_rows()
        self.made.write_text(TABLE, table_text(keys, rows))
        self.made.write_text(COLUMNS, columns_text(keys, rows))
        # a long table is written less often
        self.due = time.monotonic() + SECONDS_PER_TABLE + 10.0 * (time.monotonic() - start_time)

    def _remove_partial_runs(self) -> None:
        """Remove the partial run directories of dead processes, and of this one."""
        for name in _list_directories(self.directory / RUNS, hidden=True):
            path = self.directory / RUNS / name
            match = PARTIAL_OWNER.search(name)
            owner = (int(match[2]), match[1]) if match else None
            is_abandoned = owner is None or owner == (os.getpid(), platform.node()) or is_dead(*owner)
            # a run has no lock before its first file and after its last one: so the process in its name is asked too
            if is_abandoned and is_free(path):
                shutil.rmtree(path, ignore_errors=True)

    def _report_progress(self, digest: str, open_ones: Mapping[Future[PointAnswer], str] | None = None) -> None:
        running = [
            point_hash
            for future, point_hash in (open_ones or {}).items()
            if future.running() and self._get_partial_path(point_hash).exists()
        ]
        seconds_left = (time.monotonic() - self.start_time) / self.new * len(self.pending) if self.new else None
        event = SweepProgress(
            text=_format_progress(self.done, len(self.points), len(running), self.failed, seconds_left),
            done=self.done,
            total=len(self.points),
            running=len(running),
            failed=self.failed,
            left=seconds_left,
            row=self._make_row(self.by_hash[digest]) if digest else None,
            axes=[axis.key for axis in self.plan.axes],
            places=self.places[digest] if digest else (),
            now=[self.places[point_hash][0] for point_hash in running],
            seconds=time.monotonic() - self.start_time,
        )
        self.notify(event)
        self.broadcast(event)


def run_name(axes: Sequence[Axis], point: Point) -> str:
    """Return the name of a point's directory: its values for a reader, and the beginning of its hash for the
    program."""
    settings = []
    for axis, value in zip(axes, point.values, strict=True):
        steps = [str(step) for step in axis.path if step != "name"]
        settings.append(f"{steps[-1] if steps else axis.key}={value_text(value)}")
    text = re.sub(r"[^A-Za-z0-9=.,+_-]+", "-", re.sub(r"[][(){}]|(?<=,)\s", "", "_".join(settings)))
    return f"{text[:MAX_RUN_NAME_LETTERS].strip('-.,') or 'point'}-{point.hash[:HASH_DIGITS]}"


@contextmanager
def _open_workers(factory: ExecutorFactory) -> Iterator[Any]:
    """Open an executor, and ignore the error at its end that its workers died, which is handled elsewhere."""
    try:
        with factory.open() as executor:
            yield executor
    except BrokenExecutor:
        return


def _list_directories(folder: Path, hidden: bool = False) -> list[str]:
    if not folder.is_dir():
        return []
    return sorted(path.name for path in folder.iterdir() if path.name.startswith(".") == hidden and path.is_dir())


def _read_result(directory: Path, digest: str) -> dict[str, Any] | None:
    """Return the result of a run, if it is complete and belongs to this config."""
    try:
        summary = read_summary(directory / "result.json")
    except InputError:
        return None
    origin = summary.get("provenance")
    same = isinstance(origin, Mapping) and origin.get("hash") == digest
    return dict(finite(summary)) if same and summary["message"] != UNFINISHED else None


def _format_progress(done: int, total: int, running: int, failed: int, left: float | None) -> str:
    phrases = [f"{done} of {total} points done"]
    phrases += [f"{failed} failed"] if failed else []
    phrases += [f"{running} running"] if running else []
    phrases += [f"about {_format_duration(left)} left"] if left is not None and done < total else []
    return ", ".join(phrases)


def _format_duration(seconds: float) -> str:
    if seconds < 100:
        return f"{max(1, round(seconds))} s"
    return f"{round(seconds / 60)} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def _draw_figure(study: Study) -> Study:
    """Draw the figure of a study; where it cannot be drawn, there is a warning."""
    from sparserob_core.experiment.figures.style import save_figure
    from sparserob_core.experiment.sweep.figure import draw_study

    try:
        if study.table and not study.stopped:
            save_figure(study.directory / "sweep", draw_study, study)
    except KeyboardInterrupt:
        return replace(study, remarks=(*study.remarks, "no figure: it was interrupted"))
    except SparseRobError as error:
        return replace(study, remarks=(*study.remarks, str(error)))
    except Exception as error:  # noqa: BLE001  a figure may not end a study
        return replace(study, remarks=(*study.remarks, f"the figure could not be drawn: {named(error)}"))
    return study
