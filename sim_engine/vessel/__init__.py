"""Vessels: from a profile or a mesh to a solid, its distance grid, its cavity and its lip."""
