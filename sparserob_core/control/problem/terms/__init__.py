"""Terms of a problem that constrain its state and its control: during windows, added up, and as a period ends."""
