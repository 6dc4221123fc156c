"""Adapter for InterUSS' Flight Planning Automated Testing Interface, served with `--automated-testing` only."""
