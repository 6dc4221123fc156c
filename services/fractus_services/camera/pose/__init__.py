"""Where the camera is, where it was, and how well both are known."""
