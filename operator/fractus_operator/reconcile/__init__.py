"""Brings the cluster to what its objects ask for: one module for each step from an Application to its pods."""
