"""Global maximisation of a function over a box: counted evaluations, local search, and events."""
