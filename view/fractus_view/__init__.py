"""Live view: a web page of flights from recordings or a cluster, served by a read-only server."""
