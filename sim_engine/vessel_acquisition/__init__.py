"""Vessel shapes from measurements: outlines, photographs, point clouds, meshes."""
