"""Settings of the online algorithms that steer or correct a frozen DTFM, and of a DTFM that goes on by itself."""
