"""How much uncertainty a problem tolerates."""
