"""The Go1: how well models of it agree."""
