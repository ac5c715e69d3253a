"""The most violated index of a constraint family."""
