"""Emulated balances behind a pseudo-terminal."""
