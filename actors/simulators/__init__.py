"""The pool of simulators and its workers."""
