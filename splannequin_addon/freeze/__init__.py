"""The Freeze step: renders the frozen instant, or scrubs through it."""
