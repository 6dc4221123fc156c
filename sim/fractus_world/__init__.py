"""The world below a simulated drone: a ground, what moves on it, and the picture that a camera takes of it."""
