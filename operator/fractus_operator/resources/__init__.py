"""Builders of child objects, and of the Secrets with the certificates of instances."""
