"""Guards the standard output: HiGHS, which says a line about itself as it is made, writes nothing there."""

import subprocess
import sys

PROGRAM = """
from sparserob_core.sip.inner.simplex.growing import GrowingProgram
import numpy as np
program = GrowingProgram()
program.variables(np.zeros(2), np.ones(2), -np.ones(2))
assert program.solve()[0]
print("ours")
"""


def test_a_linear_program_leaves_nothing_on_the_standard_output() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, check=True)
    assert done.stdout == b"ours\n"
