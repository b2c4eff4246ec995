"""Motion search in a clip with known cameras: motion mattes, and dense points of still surfaces."""
