"""What a run makes of a result before it is written down: bounds without rounding, times of action, causal policies."""
