"""What the state does: responses to control and disturbance, of known, uncertain and changing systems."""
