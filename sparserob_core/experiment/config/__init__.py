"""A config file as checked, typed data, and errors that name the place."""
