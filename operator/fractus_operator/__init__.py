"""The kopf operator: thin handlers, services, one store."""
