"""What every command shares with the shell that started it: signals, streams, a line of progress."""
