"""URScript: parsed, translated into Python generators, and run one control cycle at a time."""
