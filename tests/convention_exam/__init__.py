"""Random logs with one convention broken, and sound ones."""
