"""The reading of a config from a file, a text or a mapping, with the place of every key; and its overrides."""
