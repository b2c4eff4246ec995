"""Takes: planning, rendering and writing of frozen frames, rendering in parts on a farm, and the take's verdict."""
