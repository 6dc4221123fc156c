"""Recordings of flights: MCAP files with Foxglove's schemas, and what is in them."""
