"""The conversion of a problem that was written in Python into the keys of a config with the same meaning."""
