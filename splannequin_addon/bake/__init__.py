"""The Bake step: inserts the freeze into the scene's compositor and renders it."""
