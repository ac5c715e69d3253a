"""The contract of a policy: what the control may know, said once and for all."""

from __future__ import annotations

import inspect
import pickle
from typing import get_args

from sparserob_core.control.policies.policy import Policy, Quantity
from sparserob_core.testing.contract import Contract, broken, demand

QUANTITIES = frozenset(get_args(Quantity))


class PolicyContract(Contract[Policy], kind="policy"):
    """What every policy must keep: subclass it as ``class TestMine(PolicyContract)`` and give ``component``.

    ``knows`` is a property: the frozen set of the quantities (``state``, ``disturbance``, ``parameters``) whose *past*
    values are known when the control is chosen. Nothing can be known of the future. It is a promise about the whole
    run, so it never changes. Of the policies that know something only `AffinePolicy` can be transcribed.
    """

    def known(self, policy: Policy) -> frozenset[str]:
        """What the policy knows; a broken contract where that cannot be known."""
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
        beyond = sorted(str(one) for one in knows - QUANTITIES)
        demand(
            not beyond,
            f"knows names {', '.join(beyond)}, which no control can know",
            f"name quantities whose past values are measured: {', '.join(sorted(QUANTITIES))}; the future is not known",
        )
        return knows

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
        policy, other = self.create(), self.create()
        demand(
            policy == other and hash(policy) == hash(other),
            "two policies with the same options are not equal",
            "derive it from `sparserob_core.Policy` and `sparserob_core.Options`, and add no other fields",
        )
