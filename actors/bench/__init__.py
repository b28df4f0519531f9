"""The virtual bench: a whole laboratory's pour without hardware."""
