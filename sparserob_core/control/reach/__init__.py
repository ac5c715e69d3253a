"""Enclosures of the effect of uncertainty on functionals of the state, over cells of time, parameters and
directions."""
