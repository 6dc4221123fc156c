"""Container images: builds, a local store, and delivery to the nodes of an embedded cluster."""
