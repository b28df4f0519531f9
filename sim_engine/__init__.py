"""What a pour is, and how liquid moves. The lowest floor: it knows neither actors nor orchestrator."""

import os

# pydantic looks through all that is installed for plug-ins of its own: a fiftieth of a second in every process.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
