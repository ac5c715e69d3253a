"""Working sets of an exchange: the imposed constraints, their solution, and the accounts of a method."""
