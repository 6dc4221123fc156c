"""All Kubernetes I/O of the agent."""
