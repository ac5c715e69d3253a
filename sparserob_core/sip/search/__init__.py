"""Global maximisation of a function over a box: accounts, local search, and events."""
