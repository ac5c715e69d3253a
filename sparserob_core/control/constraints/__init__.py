"""State and control constraints as families of a semi-infinite program."""
