"""A take on disk: its plan, its frames as files, its parts on a farm, its verdict."""
