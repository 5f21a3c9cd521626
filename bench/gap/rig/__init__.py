"""What a rig can be made to do: runs that an experimenter could record, and its limits."""
