"""Algorithms compared on a grid of training runs: what runs them and writes rows; `report` says what the rows say."""
