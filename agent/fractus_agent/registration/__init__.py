"""The node's Drone or EdgeNode, and its status."""
