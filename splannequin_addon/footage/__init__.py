"""The step Import: footage into a shot folder."""
