"""Contact and probe make a motion."""
