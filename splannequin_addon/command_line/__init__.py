"""Command line of the add-on, without a window: `blender --command splannequin`."""
