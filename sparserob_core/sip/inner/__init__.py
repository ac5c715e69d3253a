"""Solution of one finite convex program: standard form, solver, repair, checked residuals, and bounds from
multipliers."""
