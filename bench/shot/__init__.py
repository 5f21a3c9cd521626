"""The bounce shot: tune a simulator to one recorded drop, plan a shot in it, make the shot in
another world.

`settings` reads the experiment's [shot] table, `deal` draws balls, scenes and release errors and
records the drops, `tune` turns a recording into models and plans without knowing the ball, `throw`
makes the shots, `study` runs it all, `table` and `pictures` tell what came out.
"""
