"""The gRPC side of the mobility service: handlers, streams, arguments, and the wiring of the server."""
