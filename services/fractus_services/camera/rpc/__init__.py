"""gRPC of the camera service: handlers, the server, and the telemetry client."""
