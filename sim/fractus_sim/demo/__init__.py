"""The demo: deploys the traffic monitoring example on a cluster, watches it fly, and reports what happened."""
