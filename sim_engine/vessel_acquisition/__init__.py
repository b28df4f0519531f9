"""Vessel shapes from measurements: outlines, photographs, meshes."""
