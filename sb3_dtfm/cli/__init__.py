"""The `sb3-dtfm` command line: one file a command."""
