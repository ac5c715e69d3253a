"""A problem as the checker follows it: integrals and parameters as states, one grid for all disturbances."""
