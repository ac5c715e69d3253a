"""How far what is uncertain pushes functionals of the state, enclosed over cells of time, parameters and directions."""
