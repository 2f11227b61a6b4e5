"""Command line and RL-Zoo: `dt` and `dtfm` beside the Zoo's own algorithms."""
