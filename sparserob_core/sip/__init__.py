"""The optimisation wing: semi-infinite programs and their exact solution; knows nothing of control."""
