"""Registration of the node: its Drone or EdgeNode, and the status of that object."""
