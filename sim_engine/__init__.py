"""What a pour is, and how liquid moves. The lowest floor: it knows neither actors nor orchestrator."""
