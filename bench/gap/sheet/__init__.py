"""The data sheet of a joint or actuator: what logs say of it, and what they do not."""
