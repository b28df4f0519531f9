"""Declarations of settings, units and plug-in groups."""
