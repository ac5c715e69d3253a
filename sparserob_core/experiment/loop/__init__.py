"""A plan in closed loop: the controller of a config or of a run, and what it does to the system under disturbances."""
