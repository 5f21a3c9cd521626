"""explain: show what a simulation gets wrong, name the cause, extend the model, measure the gain.

Read `explain` first: it is the order of events. `model` fits, `causes` finds and names, `measure`
and `assess` put what was found into numbers, `verdict` is the answer, `report` tells a person.
"""
