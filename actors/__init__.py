"""Who can do it: simulators, arm, balance, optimiser. Ray lives on this floor only."""
