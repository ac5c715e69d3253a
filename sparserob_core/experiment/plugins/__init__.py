"""Components by name: hooks, records, discovery, and the components of the core."""
