"""The emulated Franka of a virtual bench: franky-sim."""
