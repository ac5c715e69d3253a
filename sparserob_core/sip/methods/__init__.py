"""The algorithms: exchange, the paper's search over tuples, and the baselines."""
