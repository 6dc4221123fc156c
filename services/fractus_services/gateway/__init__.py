"""Policy gateway for MAVLink programs: decodes each frame, decides, and calls the mobility service."""
