"""Random logs with one broken convention, and correct logs."""
