"""Robots read from MJCF or URDF model files, as systems with effects at places."""
