"""One run of a campaign: run service, stages, request execution, resuming and the run folder."""
