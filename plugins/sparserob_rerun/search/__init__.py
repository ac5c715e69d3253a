"""Pictures of a search as it climbs: its evaluations, its path, and the landscape of g around it."""
