"""Every exception that SparseRob raises on purpose, under one base class.

An error says what it was about (a config key, an argument, a plugin), what it was given and what was
expected, in one sentence: the command line prints that sentence and nothing else.
"""

from __future__ import annotations


class SparseRobError(Exception):
    """Base class. ``exit_status`` is what the command line returns for it."""

    exit_status = 5


class InputError(SparseRobError, ValueError):
    """An argument, array, option or file is at fault; the message names it and what was expected."""

    exit_status = 2


class ConfigError(InputError):
    """A config is at fault; each line of the message is ``file:line:column: key: what is wrong``."""


class NotEnclosable(InputError):
    """A function of the parameters has no rigorous enclosure on a cell: a singularity, or an operation that is not
    supported."""


class PluginError(InputError):
    """A plugin is missing, broken, or registered twice."""


class SolverError(SparseRobError):
    """No registered formulation of a finite program could be solved to a checked answer."""
