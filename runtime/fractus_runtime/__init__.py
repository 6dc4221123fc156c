"""Infrastructure shared by all processes: Kubernetes client, audit log, atomic files, metrics, tracing and logging."""
