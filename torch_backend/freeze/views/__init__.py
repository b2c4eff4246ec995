"""Clip frames as source views: where a plate shows a point, what moves in it, and region operations on masks."""
