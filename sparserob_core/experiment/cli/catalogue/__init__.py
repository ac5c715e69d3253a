"""Commands about what there is: components, examples, the schema of a config."""
