"""Pours of a wanted amount, with the tilt decided while the liquid flows."""
