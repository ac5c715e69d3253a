"""The problem in the checker's form: integrals and parameters as states, one grid for all disturbances."""
