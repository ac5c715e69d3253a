"""Global maximisation of a function over a box: accounts, polish, and what observers are told."""
