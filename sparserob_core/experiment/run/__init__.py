"""One run: the walk, its events, its journal, and how it is watched and replayed."""
