"""The node's Grants: verified, on disk, and reported."""
