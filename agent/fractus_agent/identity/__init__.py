"""The node's certificate: requested, verified, renewed."""
