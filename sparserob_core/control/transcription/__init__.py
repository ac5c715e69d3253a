"""Transcription of a control problem into its semi-infinite program, and the record that links the two."""
