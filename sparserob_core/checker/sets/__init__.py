"""The sets of a problem in ball arithmetic."""
