"""The claims of a run, checked one after another."""
