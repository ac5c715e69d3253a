"""Sampled trajectories of a finished run beside its worst case."""
