"""Results for people: progress, summary, tables, figures and HTML report."""
