"""Language guard: private words, docstring beginnings, commit subjects and file names."""
