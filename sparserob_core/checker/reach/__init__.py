"""What the state does, in ball arithmetic: flows, worst disturbances, tubes."""
