"""What the operator knows of the cluster: a current, typed view, with the claims and bookings that it implies."""
