"""Experiments, scenarios, the demo and their reports, on the simulated vehicle, camera world and embedded cluster."""
