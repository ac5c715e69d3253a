"""Runs of an experiment: their events, record, figures, outcome and replay."""
