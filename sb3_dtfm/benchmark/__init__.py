"""DT against DTFM: a grid of training runs, their rows of results, and the report made from them."""
