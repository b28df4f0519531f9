"""Files of campaigns, laboratories and vessels: sections, validation, the plans made from them, and prior data."""
