"""The flow of the system: guessed in numbers, verified in balls."""
