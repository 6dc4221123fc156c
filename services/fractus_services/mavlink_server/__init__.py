"""Vehicle side of MAVLink protocols, for the simulated vehicle and the gateway. This package does no I/O."""
