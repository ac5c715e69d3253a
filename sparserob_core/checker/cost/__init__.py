"""The cost of a control, in balls: norms on every piece, and integrals along the nominal trajectory."""
