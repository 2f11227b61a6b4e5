"""Settings of the online algorithms: noise-space RL, residual RL, and DTFM's own online fine-tuning."""
