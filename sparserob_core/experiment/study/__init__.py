"""The kit of every study: its directory, its files, its figure."""
