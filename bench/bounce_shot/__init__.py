"""Bounce shot: tune a simulator to one recorded drop, plan a shot in it, execute it elsewhere.

The shot is executed in another simulator, the true world. `shot_config` reads the experiment's
[shot] table, `shot_sampling` draws balls, scenes and release errors, `drop_recording` records the
drops, `drop_tuning` tunes every method to a recording without knowing the ball, `shot_planner`
plans a shot in a tuned model, `shot_execution` executes the shots, `shot_storage` stores them, and
`shot_study` runs all steps. `shot_report` reports the results with `hit_rate_table`, `shot_figures`
and `shot_animation`.
"""
