"""The camera service: takes, filters, stores and returns images of a drone or an edge node under policies."""
