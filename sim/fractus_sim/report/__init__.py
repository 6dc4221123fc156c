"""Reports of flights: summary page, figures, GeoJSON and machine-readable results. The output is deterministic."""
