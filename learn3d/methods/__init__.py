"""Training steps, one file per method."""
