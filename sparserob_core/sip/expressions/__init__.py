"""Expressions in named variables: parsed, evaluated, and enclosed on boxes."""
