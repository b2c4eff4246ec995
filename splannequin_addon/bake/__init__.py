"""The step Bake: the freeze in the scene's compositor, and its render."""
