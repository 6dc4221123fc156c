"""The demo: deploys the traffic monitoring example on a cluster, observes its flight, and writes a report."""
