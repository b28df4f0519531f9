"""Vessels: solid, distance grid, cavity and lip, from a profile or a mesh."""
