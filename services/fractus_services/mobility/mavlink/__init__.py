"""The autopilot: link, dialect, vehicle state, modes, failsafes and fence."""
