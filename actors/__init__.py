"""The actors of a laboratory: simulators, arm, balance and optimiser. Ray is used in this layer only."""
