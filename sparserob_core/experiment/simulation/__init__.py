"""Simulations of finished runs: sampled trajectories and replayed worst cases."""
