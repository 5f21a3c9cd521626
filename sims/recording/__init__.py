"""Measured data on disk, `NAME.csv` and `NAME.toml`.

The main modules, in the order in which to read them:

* `recording`: the data classes of a recording and the functions that read one
* `description`: the TOML file, which states what the columns are
* `table`: the CSV file, read cell by cell; `fast` reads large faultless ones
* `frame`: columns of a pandas DataFrame, checked as those of a CSV file
* `units`: conversion of the file's units to SI units
* `write`: write a recording such that reading gives it back unchanged
"""

from sims.recording.recording import Recording, Run, read_recording, read_system_name

__all__ = ["Recording", "Run", "read_recording", "read_system_name"]
