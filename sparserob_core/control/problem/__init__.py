"""What is to be controlled: systems, sets, windows, and the dictionaries that controls are written in."""
