"""All Kubernetes I/O of the operator: reads, writes, watches, and the Lease that says which operator is the leader."""
