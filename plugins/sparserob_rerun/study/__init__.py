"""Pictures of a study while it goes on: the map of its statuses, what runs, and the bounds of that."""
