"""Data sheet of a joint or actuator: identified numbers, and detection limits of absent effects."""
