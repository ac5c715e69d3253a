"""Balls, power series of ball matrices, Bernstein maxima."""
