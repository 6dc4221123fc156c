"""Camera drivers, one module for each kind of camera."""
