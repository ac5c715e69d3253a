"""Proofs of a decision over the whole continuum, and of infeasibility, and the sentences that report them."""
