"""Pictures of the system: control, states, the reason of every switch, the state space."""
