"""Margins: the critical factor on a part of a problem, and the shortest feasible horizon."""
