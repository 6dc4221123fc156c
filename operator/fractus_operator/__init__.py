"""Kubernetes operator of Fractus: plans Applications, issues Grants, and creates the child objects."""
