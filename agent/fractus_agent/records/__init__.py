"""Recording endpoint of the agent: records of the flights of plans, for users with permission to read them."""
