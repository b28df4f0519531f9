"""Results for people: progress, summary, tables, figures, HTML report, and recorded pours with their fits."""
