"""The set of initial states from which a problem is feasible."""
