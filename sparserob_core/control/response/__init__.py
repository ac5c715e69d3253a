"""What the state does: responses to control and disturbance, and their enclosures over cells of time and parameter."""
