"""The contract of a policy: what the control may know and what it answers, said once and for all."""

from __future__ import annotations

import inspect
import pickle
from typing import get_args

import numpy as np

from sparserob_core.control.policies.policy import Charge, Policy, Quantity, answers_of
from sparserob_core.errors import InputError
from sparserob_core.testing.contract import Contract, broken, demand

QUANTITIES = frozenset(get_args(Quantity))
GRIDS = ([0.0, 2.0], [0.0, 0.1, 0.3, 0.7, 1.0], [0.0, 1e-3, 2e-3, 3e-3], [float(k) for k in range(13)])
"""Breakpoints of a control: of one piece, of uneven ones, of short ones, of many."""


class PolicyContract(Contract[Policy], kind="policy"):
    """Contract of a policy: subclass it as ``class TestMine(PolicyContract)`` and give ``component``.

    ``knows`` is a property: the frozen set of the quantities (``state``, ``disturbance``, ``parameters``) whose *past*
    values are known when the control is chosen. Nothing can be known of the future. The set is a promise about the
    whole run, so it never changes. ``answers(breakpoints)`` returns truth values ``(K, K)`` for breakpoints
    ``(K + 1,)``: whether the control on piece ``k`` answers the measurement at breakpoint ``j``, which is never later
    than the piece. A policy that answers anything knows the ``state``. ``charge`` is a `Charge`, the cost by which the
    policy is chosen.
    """

    def known(self, policy: Policy) -> frozenset[str]:
        """Return the quantities that the policy knows; the contract is broken where ``knows`` raises, or is no set of
        quantities that can be known."""
        try:
            knows: object = policy.knows
        except Exception as error:  # noqa: BLE001  a component may raise anything, and must not
            broken(f"knows raised {type(error).__name__}: {error}", "return a frozenset, empty for an open loop")
        demand(
            not inspect.ismethod(knows) and not inspect.isfunction(knows),
            "knows is a method",
            "write `@property` above it: it is read, not called",
        )
        if not isinstance(knows, frozenset):
            broken(
                f"knows is {knows!r}, a {type(knows).__name__}",
                'return a frozenset, such as `frozenset()` or `frozenset({"state"})`: nobody may add to it later',
            )
        unknown = sorted(str(quantity) for quantity in knows - QUANTITIES)
        demand(
            not unknown,
            f"knows names {', '.join(unknown)}, which no control can know",
            f"name quantities whose past values are measured: {', '.join(sorted(QUANTITIES))}; the future is not known",
        )
        return knows

    def answered(self, policy: Policy, breakpoints: list[float]) -> np.ndarray:
        """Return the policy's table of answers; the contract is broken where it is no table of truth values, or answers
        too early."""
        times = np.array(breakpoints)
        try:
            mask = answers_of(policy, times)
        except InputError as error:
            broken(
                f"on {len(breakpoints) - 1} pieces: {error}",
                "return a square array of truth values from `answers`, one row for each piece, True only where the"
                " breakpoint is no later than the piece, and name the state in `knows`",
            )
        except Exception as error:  # noqa: BLE001  a component may raise anything, and must not
            broken(f"answers raised {type(error).__name__}: {error}", "let it take any increasing times from 0 on")
        return mask

    def test_it_knows_past_values_of_named_quantities_only(self) -> None:
        self.known(self.create())

    def test_what_it_knows_never_changes(self) -> None:
        policy = self.create()
        first = self.known(policy)
        for _ in range(20):
            demand(
                self.known(policy) == first == self.known(self.create()),
                f"knows was {sorted(first)} and is {sorted(self.known(policy))} later",
                "return a constant, or what the options say: neither a clock, a counter nor the surroundings",
            )

    def test_reading_what_it_knows_changes_nothing_about_it(self) -> None:
        policy = self.create()
        before = dict(vars(policy))
        self.known(policy)
        demand(
            vars(policy) == before,
            "reading `knows` has changed the policy",
            "let the property only answer",
        )

    def test_a_copy_in_another_process_knows_the_same(self) -> None:
        policy = self.create()
        try:
            copy: object = pickle.loads(pickle.dumps(policy))  # noqa: S301  made here
        except Exception as error:  # noqa: BLE001  whatever pickle meets
            broken(
                f"it cannot be sent to another process: {type(error).__name__}: {error}",
                "define its class at the top level of a module, and keep neither lambdas nor open files",
            )
        assert isinstance(copy, Policy)
        demand(
            self.known(copy) == self.known(policy),
            f"a copy knows {sorted(self.known(copy))}, the original {sorted(self.known(policy))}",
            "let `knows` depend on the options only",
        )

    def test_its_options_are_what_it_depends_on(self) -> None:
        policy, twin = self.create(), self.create()
        demand(
            policy == twin and hash(policy) == hash(twin),
            "two policies with the same options are not equal",
            "derive it from `sparserob_core.Policy` and `sparserob_core.Options`, and add no other fields",
        )

    def test_it_answers_what_is_measured_by_then_and_nothing_else(self) -> None:
        for breakpoints in GRIDS:
            self.answered(self.create(), breakpoints)

    def test_what_it_answers_depends_on_its_options_and_the_breakpoints_alone(self) -> None:
        policy = self.create()
        copy = pickle.loads(pickle.dumps(policy))  # noqa: S301  made here
        for breakpoints in GRIDS:
            first = self.answered(policy, breakpoints)
            for twin in (policy, self.create(), copy):
                demand(
                    bool((self.answered(twin, breakpoints) == first).all()),
                    f"on {len(breakpoints) - 1} pieces it answers other measurements when it is asked again",
                    "let `answers` depend on the breakpoints and the options only, and not write into them",
                )

    def test_its_charge_is_a_cost_that_is_known(self) -> None:
        charge: object = self.create().charge
        if not isinstance(charge, Charge):
            broken(f"charge is a {type(charge).__name__}", "return a `sparserob_core.Charge` from the property")
        demand(
            charge.cost in ("nominal", "peak", "worst") and charge == self.create().charge,
            f"charge is {charge}",
            'name a cost of nominal, peak and worst, the same whenever it is asked, as in `sr.Charge(cost="peak")`',
        )
