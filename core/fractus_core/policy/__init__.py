"""Policy engine: compiles Grants and decides on calls and on the motion of a flying drone."""
