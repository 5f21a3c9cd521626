"""Bounce shot: tune a simulator to one recorded drop, plan a shot in it, execute it elsewhere.

The shot is executed in another simulator, the true world. `settings` reads the experiment's [shot]
table, `deal` draws balls, scenes and release errors and records the drops, `tune` converts a
recording to models and plans without knowing the ball, `throw` executes the shots, `study` runs all
steps, `table` and `pictures` report the results.
"""
