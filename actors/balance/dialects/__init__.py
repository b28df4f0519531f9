"""How balances talk: bytes to readings and back, one dialect a file, no ports. `actors.balance.dialect_registry`
finds them."""
