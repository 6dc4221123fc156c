"""The autopilot: link, vehicle state, modes, failsafes and fence."""
