"""Optimisation: semi-infinite programs and their exact solution; this folder does not depend on control."""
