"""Feedback of measurements: innovations, gains, and the state of the closed loop."""
