"""YAML files: reading with places, validation of sections, references between files, problems, and writing."""
