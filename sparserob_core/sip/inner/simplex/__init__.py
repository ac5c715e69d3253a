"""The simplex method for rows that hold for every deviation, on one linear program that grows."""
