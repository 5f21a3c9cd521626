"""Measured data on disk, `NAME.csv` and `NAME.toml`; the rooms in the order in which to read them.

* `recording`: what a recording is, and how one is read: the contract, and all that others need
* `description`: the TOML file, what the columns are
* `table`: the CSV file, cell by cell; `fast` reads large faultless ones
* `frame`: columns of a pandas DataFrame, checked as those of a CSV file
* `units`: how the file's units become SI
* `write`: a recording written such that reading gives the same back
"""

from sims.recording.recording import Recording, Run, read_recording, system_of

__all__ = ["Recording", "Run", "read_recording", "system_of"]
