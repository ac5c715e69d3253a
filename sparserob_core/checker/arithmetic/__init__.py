"""Balls, power series of ball matrices, and upper bounds by Bernstein's form."""
