"""The simulated vehicle: an ArduCopter-compatible multicopter that speaks MAVLink 2."""
