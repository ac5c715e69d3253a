"""Every exception that SparseRob raises on purpose, under one base class.

An error says what it was about (a config key, an argument, a plugin), what it was given and what was
expected, in one sentence: the command line prints that sentence and nothing else.
"""

from __future__ import annotations

from typing import Self, TypeAlias

Path: TypeAlias = tuple[str | int, ...]
"""The way to a value in a nested config: keys, and positions in lists."""


def steps(path: str | Path) -> Path:
    """``"path.0.from"`` as ``("path", 0, "from")``."""
    if not isinstance(path, str):
        return tuple(path)
    return tuple(int(step) if step.isdigit() else step for step in path.split(".") if step)


def dotted(path: Path) -> str:
    """``("path", 0, "from")`` as ``"path.0.from"``."""
    return ".".join(str(step) for step in path)


def named(error: BaseException) -> str:
    """An exception as its type and, where it has one, its message."""
    return f"{type(error).__name__}: {error}".removesuffix(": ")


def not_installed(package: str, project: str | None = None) -> str:
    """A package that is missing, with what brings it, as half a sentence: ``matplotlib is not installed; `pip install
    'matplotlib>=3.9'` brings it``. ``project``: what pip knows it by, the same unless given, ``""`` where pip cannot
    bring it. The bound of its version is the one that this distribution states, where it states one."""
    from importlib.metadata import PackageNotFoundError, requires

    brings = package if project is None else project
    if not brings:
        return f"{package} is not installed"
    try:
        stated = [line.partition(";")[0].strip() for line in requires("sparserob") or ()]
    except PackageNotFoundError:  # the source is on the path, and no distribution
        stated = []
    wanted = next((line for line in stated if line.startswith(tuple(brings + mark for mark in "><=!~"))), brings)
    return f"{package} is not installed; `pip install '{wanted}'` brings it"


class SparseRobError(Exception):
    """Base class. ``exit_status`` is what the command line returns for it."""

    exit_status = 5


class InputError(SparseRobError, ValueError):
    """An argument, array, option or file is at fault.

    ``path`` is the key or argument, as steps or with dots (``problem.path.0.box``); either ``message`` says what is
    wrong with it, or ``expected`` and ``got`` do. Whoever passes the error on says where it sits with `under`; the
    sentence is put together only when it is shown.
    """

    exit_status = 2

    def __init__(self, message: str = "", *, path: str | Path = (), expected: str = "", got: str = "") -> None:
        super().__init__(message)
        self.message, self.expected, self.got, self.path = message, expected, got, steps(path)

    def under(self, *prefix: str | int) -> Self:
        """Put ``prefix`` before the path of the error, whose value sits below it; return the error itself, to be raised
        again."""
        self.path = tuple(step for entry in prefix for step in steps(str(entry))) + self.path
        return self

    @property
    def sentence(self) -> str:
        """Description of the fault without its place."""
        if self.expected:
            return f"expected {self.expected}, got {self.got}" if self.got else f"expected {self.expected}"
        return self.message

    def __str__(self) -> str:
        return f"{dotted(self.path)}: {self.sentence}" if self.path else self.sentence


class ConfigError(InputError):
    """A config is at fault; each line of the message is ``file:line:column: key: what is wrong``."""


class TimeLimitError(SparseRobError):
    """The limit ``limits.seconds`` was reached before anything was known of the problem."""

    exit_status = 4


class NotEnclosable(InputError):
    """A function of the parameters has no rigorous enclosure on a cell: a singularity, or an operation that is not
    supported. ``along``: the parameter in which a narrower cell helps most, where that is known."""

    def __init__(
        self,
        message: str = "",
        *,
        path: str | Path = (),
        expected: str = "",
        got: str = "",
        along: int | None = None,
    ) -> None:
        super().__init__(message, path=path, expected=expected, got=got)
        self.along = along


class PluginError(SparseRobError):
    """A plugin or one of its components is at fault: its code raised, or returned what its kind must not return. The
    message names the component, its kind, and the plugin with its file or distribution."""


class UnknownPluginError(PluginError, InputError):
    """A component or a plugin is unknown, not installed, disabled, or registered twice."""

    exit_status = 2


class SolverError(SparseRobError):
    """No registered formulation of a finite program could be solved to a checked answer."""
