"""The last steps of a run before its result is written: exact bounds, times of action, bounds for causal policies."""
