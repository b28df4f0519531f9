"""What the `decant` command does, one file per verb. Heavy packages are imported when a verb needs them."""
