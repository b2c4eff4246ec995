"""The step Train: learning the scene."""
