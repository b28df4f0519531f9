"""From a pour to the joints of an arm: planned, and checked as a whole before the first movement."""
