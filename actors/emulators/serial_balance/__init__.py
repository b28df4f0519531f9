"""Emulated balances behind a pseudo-terminal or a TCP port."""
