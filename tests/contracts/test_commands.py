"""Guards sparserob_core.testing and every registered command: all of the core keep what needs no arguments of the
contract, and the contract is worth keeping: commands that are bad on purpose fail it."""

from __future__ import annotations

import itertools
import os
import sys
from pathlib import Path

import click
import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.testing import CommandContract
from tests.support.faults import fails

REGISTRY = sr.load_registry()
COUNT = itertools.count()
HELP, STATUS = "test_it_says_what_it_does_and_what_its_options_mean", "test_it_returns_its_exit_status"
SHOWN = "test_help_is_shown_and_nothing_is_done"


def command(function, *params, text="Do something.", **options):
    return click.Command("trial", callback=function, params=list(params), help=text, **options)


@pytest.mark.parametrize("name", REGISTRY.names("command"))
def test_every_registered_command_says_what_it_does_and_what_its_options_mean(name):
    trial = type("Registered", (CommandContract,), {"component": name})()
    for test in (HELP, SHOWN, "test_an_unknown_option_is_refused"):
        getattr(trial, test)()


class TestAnHonestCommand(CommandContract):
    component = command(click.echo, click.Option(["--number", "message"], type=int, help="A number."))
    arguments = ("--number", "3")


def honest():
    return command(lambda: 0)


def no_help():
    return command(lambda: 0, text="")


def silent_option():
    return command(lambda number: 0, click.Option(["--number"]))


def hidden_help():
    return command(lambda high: 0, click.Option(["-h", "high"], help="How high."))


def without_help():
    return command(lambda: 0, add_help_option=False)


def hasty():
    Path("made.txt").write_text("too early")
    return command(lambda: 0)


def takes_all():
    return command(lambda: 0, context_settings={"ignore_unknown_options": True, "allow_extra_args": True})


def says_text():
    return command(lambda: "certified")


def too_large():
    return command(lambda: 256)


def truth():
    return command(lambda: True)


def leaves():
    return command(lambda: sys.exit(1))


def breaks():
    return command(lambda: 1 // 0)


def wanders():
    return command(lambda: os.chdir(".."))


def counts():
    return command(lambda: click.echo(next(COUNT)))


def draws():
    return command(lambda: click.echo(f"{np.random.random() < 2}"))  # noqa: NPY002


FAULTS = {
    no_help: HELP,
    silent_option: HELP,
    hidden_help: HELP,
    without_help: SHOWN,
    hasty: SHOWN,
    takes_all: "test_an_unknown_option_is_refused",
    says_text: STATUS,
    too_large: STATUS,
    truth: STATUS,
    leaves: STATUS,
    breaks: STATUS,
    wanders: STATUS,
    counts: "test_it_prints_the_same_twice",
    draws: "test_the_random_numbers_of_others_are_left_alone",
}


@pytest.mark.parametrize(("flawed", "test"), FAULTS.items(), ids=[one.__name__ for one in FAULTS])
def test_the_contract_catches_a_command_that_is_bad_on_purpose(flawed, test):
    fails(CommandContract, flawed, test)
