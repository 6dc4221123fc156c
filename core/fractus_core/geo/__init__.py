"""Frames, distances and areas."""
