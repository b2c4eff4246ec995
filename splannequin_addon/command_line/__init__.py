"""The add-on without a window: `blender --command splannequin`."""
