"""The scene at t*: the frozen run, compared with a static baseline, fine-tuned, and stored."""
