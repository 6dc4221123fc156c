"""From an application and an inventory to a plan that explains itself."""
