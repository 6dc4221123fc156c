"""The state of the drone, from the mobility service of the node."""
