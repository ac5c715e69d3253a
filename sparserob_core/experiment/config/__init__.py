"""The config file as checked, typed data; every error names its place."""
