"""Balances: the protocol, a virtual one, and the actor around a driver."""
