"""Certificates of semi-infinite programs that are stated as text."""
