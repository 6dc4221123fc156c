"""Whole experiments of their own: what flies, what must come out, and the pictures of it."""
