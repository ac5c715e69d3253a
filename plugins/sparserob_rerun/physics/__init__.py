"""What the system does: control, states, the reason of every switch, the state space."""
