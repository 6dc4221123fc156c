"""Testbeds: vehicles, services and clusters that experiments, scenarios, the demo and chaos runs start and observe."""
