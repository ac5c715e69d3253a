"""The statement of a control problem: its system, sets, windows, and the dictionaries of its controls."""
