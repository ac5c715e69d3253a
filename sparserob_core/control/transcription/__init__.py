"""From a control problem to its semi-infinite program, and the record that links the two."""
