"""System services of a node and what they share."""
