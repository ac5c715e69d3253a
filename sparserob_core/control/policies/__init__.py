"""Policies: what the control may know of the run while the system runs."""
