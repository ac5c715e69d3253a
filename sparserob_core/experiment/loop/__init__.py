"""Controllers of finished runs, and their simulation in closed loop."""
