"""The optimiser itself: pure functions of a question, without Ray."""
