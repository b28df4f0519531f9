"""The driver of Franka arms, and their descriptions."""
