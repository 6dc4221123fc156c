"""Flight recordings: MCAP files with Foxglove schemas, and MAVLink logs."""
