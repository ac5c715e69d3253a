"""Commands of the command line, one in every file."""
