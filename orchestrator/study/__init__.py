"""A study: many small campaigns from one file, and what they show together."""
