"""Systems that change with time: their loops, and what is missed in them."""
