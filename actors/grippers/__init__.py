"""Grippers: their interface, settings and drivers."""
