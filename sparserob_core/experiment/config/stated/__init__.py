"""What was stated in Python, as the keys of a config that say the same."""
