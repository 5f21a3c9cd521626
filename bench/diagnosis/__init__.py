"""Diagnosis: locate the model discrepancy, identify its cause, extend the model, measure the gain.

Start with `explain`, which runs the steps in order. `model` fits parameters, `causes` searches for
missing effects, `measure` and `assess` compute intervals and gains, `verdict` holds the result, and
`report` presents it.
"""
