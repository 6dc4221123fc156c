"""REST API for flights as a service. Each request acts with the bearer token of its caller on the Kubernetes API server."""
