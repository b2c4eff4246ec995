"""The Import step: reads footage into a shot folder."""
