"""The TCP interfaces of the emulated controller."""
