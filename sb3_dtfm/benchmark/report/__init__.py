"""Reports of results: statistics, tables and figures. Nothing here needs a simulator, or what made the rows."""
