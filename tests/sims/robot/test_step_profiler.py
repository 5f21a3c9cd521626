"""MuJoCo's profiler, which reads the clock in every step, is off in simulations."""

import mujoco

from sims.core.mujoco_import import disable_step_profiler

MODEL = """
<mujoco><worldbody><body><joint name="slide" type="slide"/><geom size="0.1"/></body></worldbody>
</mujoco>
"""


def measure_step_seconds(steps=100):
    """Return the seconds that MuJoCo's own profiler counts for some steps."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, steps)
    timer = data.timer[mujoco.mjtTimer.mjTIMER_STEP]
    assert timer.number == steps
    return timer.duration


def test_steps_are_not_timed_after_the_profiler_is_switched_off():
    disable_step_profiler()
    assert measure_step_seconds() == 0.0


def test_a_clock_of_the_user_stays():
    ticks = iter(range(10**6))
    disable_step_profiler.cache_clear()
    mujoco.set_mjcb_time(lambda: float(next(ticks)))
    try:
        disable_step_profiler()
        assert measure_step_seconds() > 0.0
    finally:
        mujoco.set_mjcb_time(None)
        disable_step_profiler.cache_clear()
        disable_step_profiler()


def test_the_profiler_stays_off_after_a_clock_of_the_user_is_removed():
    disable_step_profiler.cache_clear()
    disable_step_profiler()
    assert measure_step_seconds() == 0.0
