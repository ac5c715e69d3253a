"""Matrices in a file that belongs to a config, and matrices as one text within a config."""
