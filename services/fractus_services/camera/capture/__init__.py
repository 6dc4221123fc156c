"""Cameras: drivers, and the shutter that calls them on a thread."""
