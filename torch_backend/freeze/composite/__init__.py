"""One frozen frame: which source gives each pixel, and what fills the rest."""
