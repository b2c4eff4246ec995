"""The step Freeze: the frozen instant, rendered or scrubbed through."""
