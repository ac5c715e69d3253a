"""The check of a finished run: its certificate and its files are verified anew."""
