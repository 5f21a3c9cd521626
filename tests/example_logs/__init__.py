"""Scripts that made the logs of examples/, with equations of motion of their own."""
