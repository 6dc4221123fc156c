"""The simulated world: vehicle, embedded cluster."""
