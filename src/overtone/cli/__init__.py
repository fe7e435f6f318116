"""The command line: reads text with units, calls the library, prints; no science in it."""

from overtone.cli.app import main

__all__ = ["main"]
