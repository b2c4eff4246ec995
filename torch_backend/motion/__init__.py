"""What moves by itself in a clip whose cameras are known: motion mattes, and points of what stands still."""
