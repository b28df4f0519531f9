"""One run of a campaign: stages, request execution, resuming and the run folder."""
