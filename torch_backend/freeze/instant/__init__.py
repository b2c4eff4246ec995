"""The scene at t*: the run frozen, held against a static baseline, fine-tuned, and kept."""
