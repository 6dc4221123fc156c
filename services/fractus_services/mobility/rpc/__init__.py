"""gRPC layer of the mobility service: handlers, control streams, message conversion, and construction of the server."""
