"""The surface of a frozen scene, fused from the depth of a take's frames."""
