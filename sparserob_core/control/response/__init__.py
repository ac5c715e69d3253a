"""Responses of the state to control and disturbance, for known, uncertain and time-varying systems."""
