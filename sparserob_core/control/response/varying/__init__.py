"""Systems that change with time, as polynomials of it, and their transitions."""
