"""The commands, a file each, or a file for each group of commands: arguments in, a run called, results printed."""
