"""Public data sets that experiments of the project need: which there are, where they lie, and how
`simgap download` gets them.
"""
