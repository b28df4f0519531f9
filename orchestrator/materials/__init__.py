"""Contents of vessels, with their uncertainty."""
