"""Report of a study: figures, tables and an HTML page."""
