"""How bad each row of a problem can become, as a number between two bounds."""
