"""A package of a plugin to begin with: `sparserob new-plugin`."""
