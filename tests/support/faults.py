"""A component with a fault, put before the contract of its kind."""

from __future__ import annotations

import pytest

import sparserob_core as sr
from sparserob_core.testing import ContractBroken


def fails(contract, flawed, test, **attributes):
    """Assert that a test of a contract fails for a flawed component, with words on how to mend it; return its error.

    What the component itself raises, or the framework because of it, is told as it is.
    """
    trial = type("Trial", (contract,), {"component": flawed, **attributes})
    with pytest.raises(Exception) as caught:
        getattr(trial(), test)()
    error = caught.value
    if isinstance(error, AssertionError):
        assert isinstance(error, ContractBroken), f"{flawed.__name__}: an assertion without a word on how to mend it"
        assert "To mend it: " in str(error)
    else:
        assert isinstance(error, sr.SparseRobError | ArithmeticError | TypeError | ValueError | LookupError), error
    return error
