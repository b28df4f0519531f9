"""Progress of a running campaign: progress state, time estimate, console display."""
