"""Experiments: drones, services and programs on this machine, faults in time, checks, and a report."""
