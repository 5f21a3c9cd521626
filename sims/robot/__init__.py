"""Robots from model files: an MJCF or a URDF becomes a system, with effects at its places."""
