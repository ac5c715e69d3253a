"""The run directory: the one reader and the one writer of what a run leaves."""
