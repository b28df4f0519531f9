"""Balances without balances on real serial lines: another process at the far end of a pseudo-terminal."""
