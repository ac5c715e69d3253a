"""What can be asked of a transcribed problem: worst cases, simulations, sets of initial states."""
