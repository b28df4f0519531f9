"""The driver of a UR arm: consent, checks and measuring here, the client library in a process that may die."""
