"""The run directory: the only reader and the only writer of its files."""
