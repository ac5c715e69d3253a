"""Convex sets by their support functions: polytopes, curved sets, gauges, directions, samples."""
