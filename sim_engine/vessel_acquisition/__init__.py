"""Vessel shapes from measurements: outlines, meshes."""
