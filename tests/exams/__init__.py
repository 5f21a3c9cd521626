"""Exams of `simgap explain`: recordings whose causes are known, one runner and one table format."""
