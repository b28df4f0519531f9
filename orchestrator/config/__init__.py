"""Campaign files: YAML with units, composed into plans; every error with its file, line and column.

`orchestrator.config.load` has `load_campaign`, `load_vessel`, `load_laboratory` and `load_parameters`.
"""
