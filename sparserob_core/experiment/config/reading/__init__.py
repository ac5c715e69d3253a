"""From a file, a text or a mapping to the keys and values of a config, each with its place; and changes to them."""
