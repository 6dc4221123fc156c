"""Chaos tests: missions on an embedded cluster with faults from a seeded schedule, and invariants that must hold."""
