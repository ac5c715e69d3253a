"""One finite convex program: standard form, solver, repair, checked residuals, and bounds from its multipliers."""
