"""Terms of a problem that constrain state and control: during windows of time, in integrals, and at the end of a
period."""
