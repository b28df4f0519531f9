"""What all tests need."""

from __future__ import annotations

import signal

# A shell that starts something in the background has it ignore Ctrl-C, and its children with it: those that are
# interrupted here would go on.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
