"""The rounds of an exchange: bounds, violations, cuts."""
