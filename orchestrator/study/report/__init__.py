"""What a study shows: figures, tables and a page."""
