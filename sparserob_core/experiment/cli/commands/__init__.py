"""One command in every file."""
