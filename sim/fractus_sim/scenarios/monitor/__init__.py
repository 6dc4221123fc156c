"""The monitor scenario: an unmodified DroneKit program that leaves its course, with and without policies."""
