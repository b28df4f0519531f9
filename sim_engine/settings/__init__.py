"""How anything declares a setting, a unit or an entry point."""
