"""An interior point method for rows that hold for every deviation, by the blocks that gains fall into."""
