"""The daemon: a queue of campaigns, an HTTP API, and questions that wait for an operator's answer."""

PORT = 8377
"""TCP port of the API, unless the settings give another one."""

PHYSICAL = "press the physical emergency stop: the red mushroom button on the teach pendant"
"""What to do if the daemon can't stop an arm."""
