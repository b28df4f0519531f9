"""The optimiser: its pure core, and the actor around it."""
