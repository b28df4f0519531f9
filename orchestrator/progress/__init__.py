"""A running campaign in numbers: progress state, time estimate, console display."""
