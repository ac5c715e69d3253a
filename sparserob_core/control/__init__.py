"""The physics wing: sets, systems and responses; turns an optimal control problem into a semi-infinite program."""
