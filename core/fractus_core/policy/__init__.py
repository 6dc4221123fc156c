"""Policy engine: compiles Grants, and judges calls and the motion of a flying drone."""
