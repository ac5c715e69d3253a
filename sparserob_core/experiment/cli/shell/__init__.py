"""Functions of every command that concern the shell which started it: signals, streams, a line of progress."""
