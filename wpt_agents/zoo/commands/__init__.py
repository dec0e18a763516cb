"""The text of the command line: options, help and messages."""
