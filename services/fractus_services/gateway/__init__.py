"""Policy gateway for MAVLink applications: decodes each frame, decides, and calls the mobility service."""
