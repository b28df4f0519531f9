"""Arms that pour: the protocol, a virtual one, and the actor around a driver."""
