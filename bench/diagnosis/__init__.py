"""Diagnosis: locate the model discrepancy, identify its cause, extend the model, measure the gain.

Start with `explain`, which runs the steps in order. `fitting` fits parameters, `search` and
`prediction_error` look for missing effects, `validation` and `pipeline` compute intervals
and gains, `verdict` holds the result, and `report` presents it.
"""
