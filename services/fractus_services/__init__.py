"""Mobility and camera services of a node, and the modules that both services use."""
