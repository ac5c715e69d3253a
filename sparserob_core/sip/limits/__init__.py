"""The time that a computation may take, and what is made apart so that it is kept."""
