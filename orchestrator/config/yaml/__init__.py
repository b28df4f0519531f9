"""Reading YAML: places of errors, units, sections with strict keys, files that name other files."""
