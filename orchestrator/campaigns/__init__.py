"""Files of campaigns, laboratories and vessels: their sections, their validation, and the plans made from them."""
