"""Bounce shot: tune a simulator to one recorded drop, plan a shot in it, execute it elsewhere.

The shot is executed in another simulator, the true world. `shot_config` reads the experiment's
[shot] table, `shot_sampling` draws balls, scenes and release errors, `drop_recording` records the
drops, `drop_tuning` converts a recording to models and plans without knowing the ball,
`shot_execution` executes the shots, `shot_storage` stores them, `shot_study` runs all steps,
`hit_rate_table` and `shot_figures` report them.
"""
