"""From a film to a recording: the commands `simgap film` and `simgap track`."""
