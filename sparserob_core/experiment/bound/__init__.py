"""Worst cases of the rows of a problem, enclosed from both sides."""
