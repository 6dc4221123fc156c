"""The operator: plans Applications, compiles their grants, and keeps the cluster as both ask for."""
