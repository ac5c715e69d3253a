"""A search as it climbs: its evaluations, its way, and the landscape of g around it."""
