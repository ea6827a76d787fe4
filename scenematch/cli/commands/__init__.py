"""The commands, one file per command or group: each parses arguments, calls a run and prints the results."""
