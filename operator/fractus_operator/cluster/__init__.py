"""All Kubernetes I/O of the operator: reads, writes, watches, and leader election."""
