"""Pure decision makers: what to simulate, pour and ask next."""
