"""Reachable states in ball arithmetic: flows, worst-case disturbances and tubes."""
