"""The driver for UR arms."""
