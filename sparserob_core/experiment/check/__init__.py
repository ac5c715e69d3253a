"""A finished run verified anew."""
