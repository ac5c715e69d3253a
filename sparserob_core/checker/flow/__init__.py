"""The flow of the system: a polynomial guess in numbers, verified in balls."""
