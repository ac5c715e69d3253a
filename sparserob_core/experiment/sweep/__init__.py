"""Studies: a config is run at every point of some axes."""
