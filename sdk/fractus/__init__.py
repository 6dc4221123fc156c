"""What a component of a Fractus application imports."""
