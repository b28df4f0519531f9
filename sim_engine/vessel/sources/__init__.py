"""From what people can measure of a cup to its shape: diameters, photograph, points, fill and tilt tables, a mesh."""
