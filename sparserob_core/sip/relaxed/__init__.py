"""The relaxed value ``g``: the program with finitely many indices imposed, of tuples of indices, and its
derivatives."""
