"""The HTTP API with its access control, routes, schemas and client, and the operator's page."""
