"""Composites one frozen frame: chooses the source of each pixel, and fills the rest."""
