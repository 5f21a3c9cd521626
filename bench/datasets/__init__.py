"""Public data sets that experiments need: catalogue, folders on this machine, and download."""
