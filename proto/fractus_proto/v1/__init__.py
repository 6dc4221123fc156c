"""Package fractus.v1."""
