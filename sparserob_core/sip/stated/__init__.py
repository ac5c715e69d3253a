"""Semi-infinite programs that are stated as text."""
