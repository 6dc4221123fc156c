"""Scenarios: complete experiments with expectations and figures."""
