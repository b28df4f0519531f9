"""The daemon: a queue of campaigns, an HTTP API, and questions that wait for an operator's answer."""
