"""The verification of a finished run in ball arithmetic; it shares no code with the solvers."""
