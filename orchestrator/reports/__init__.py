"""Results of a run: summary, tables, figures and HTML report."""
