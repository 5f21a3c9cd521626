"""explain: show what a simulation gets wrong, name the cause, extend the model, measure the gain.

Read `explain` first: it is the order of events. `world` and `fit` are the tools; `show`, `name`,
`extend` and `measure` the four steps; `report` and `account` tell a person.
"""
