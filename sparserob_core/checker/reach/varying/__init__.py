"""Known systems that change with time, as power series of it."""
