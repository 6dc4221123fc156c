"""Camera world: a simulated ground with moving objects, and the pictures that a camera above it takes."""
