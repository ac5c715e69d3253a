"""Terms of a problem that become states of a larger system: integrals, and parameters beside the time."""
