"""What is proven of a decision over the whole continuum, or of infeasibility, and the words for it."""
