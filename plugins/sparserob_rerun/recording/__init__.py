"""Process that records: events in, what is on the screen, and where it goes."""
