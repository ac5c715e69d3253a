"""One command of the command line in every file."""
