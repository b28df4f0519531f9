"""What the daemon keeps: settings, the store, events, notifications, what is read from runs, tokens and backups."""
