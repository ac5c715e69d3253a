"""Matrices that stand in a file beside a config, and in one text within it."""
