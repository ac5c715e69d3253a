"""Verification of a finished run in ball arithmetic; shares no code with what solved it."""
