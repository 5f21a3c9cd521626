"""A camera that films a ball, the films it makes, and what a tracker sees in them."""
