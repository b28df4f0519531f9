"""Emulated devices that use the protocols of the real ones."""
