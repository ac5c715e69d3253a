"""A control that runs: a proven plan applied, or what is left of the horizon solved anew."""
