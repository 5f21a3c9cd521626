"""Measured data on disk, `NAME.csv` and `NAME.toml`.

The main modules, in the order in which to read them:

* `recording`: the data classes of a recording and the functions that read one
* `recording_description`: the TOML file, which states what the columns are
* `csv_table`: the CSV file, read cell by cell or, if it is large and faultless, by PyArrow
* `recording_frame`: columns of a pandas DataFrame, checked as those of a CSV file
* `log_formats`: logs in other formats; `log_time_alignment` joins several by time
* `unit_conversion`: conversion of the file's units to SI units
* `recording_writer`: write a recording such that reading gives it back unchanged
"""

from sims.recording.recording import Recording, Run, read_recording, read_system_name

__all__ = ["Recording", "Run", "read_recording", "read_system_name"]
