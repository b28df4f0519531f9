"""The daemon: a queue of campaigns, an HTTP API, and questions that wait for an operator's answer."""

PORT = 8377
"""TCP port of the API, unless the settings give another one."""
