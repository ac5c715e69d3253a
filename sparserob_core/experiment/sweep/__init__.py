"""Studies: one config, axes along which it is changed, and a run for every point."""
