"""Container images: building them, keeping them, and delivering them to the nodes of an embedded cluster."""
