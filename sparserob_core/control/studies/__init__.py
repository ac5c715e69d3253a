"""Studies of a transcribed problem: worst cases, simulations, and sets of initial states."""
