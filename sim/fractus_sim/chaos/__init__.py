"""Chaos: missions on an embedded cluster while its parts fail by a seeded schedule, and what must hold throughout."""
