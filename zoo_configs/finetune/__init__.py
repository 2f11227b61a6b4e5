"""Settings of the online algorithms that steer a frozen DTFM."""
