"""Rigorous bounds: Taylor models in the parameters, matrix exponentials, polynomials on boxes."""
