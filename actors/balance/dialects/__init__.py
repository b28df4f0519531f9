"""Dialects of serial balances: bytes to readings and back, one dialect per file, without ports.
`actors.balance.dialect_registry` lists them.
"""
