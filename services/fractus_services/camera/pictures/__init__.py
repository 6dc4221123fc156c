"""Judges a call, takes a picture, filters it, stores it, returns it."""
