"""A laboratory that is left running: a queue of campaigns, an API over HTTP, questions that wait for their answer."""
