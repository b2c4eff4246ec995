"""Splannequin for Blender: the repository root is the extension package.

Nothing is imported at module level: pytest imports this file in environments that have no bpy.
"""


def register() -> None:
    """Called by Blender when the extension is enabled."""
    from .splannequin_addon import registration

    registration.register()


def unregister() -> None:
    """Called by Blender when the extension is disabled."""
    from .splannequin_addon import registration

    registration.unregister()
