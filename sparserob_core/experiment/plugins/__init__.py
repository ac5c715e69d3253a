"""Components by name: hooks, records, discovery, and the built-in ones."""
