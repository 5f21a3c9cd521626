"""Films of a ball: camera model, rendering, and tracking."""
