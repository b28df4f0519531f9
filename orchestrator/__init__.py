"""What should happen next, and what has happened: strategies, scheduler, journal, command line."""
