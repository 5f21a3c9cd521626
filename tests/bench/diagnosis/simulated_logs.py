"""Motions of robots, simulated with plain MuJoCo, and logs on disk for the tests of explain."""

import mujoco
import numpy as np


def follow(model, commands, steps, start=None, start_rates=None, settle=0, act=lambda data: None):
    """Return the positions (T, Q) of a robot at the beginning of each command.

    Args:
        model: compiled model.
        commands: commands (T, U).
        steps: number of time steps of each command.
        start: initial positions (Q,); those of the model if None.
        start_rates: initial velocities; zero if None.
        settle: number of time steps with the first command before the first position.
        act: function that changes the state before each time step, for example its forces.
    """
    data = mujoco.MjData(model)
    if start is not None:
        data.qpos[:] = start
    if start_rates is not None:
        data.qvel[:] = start_rates
    data.ctrl[:] = commands[0]
    mujoco.mj_step(model, data, settle)
    positions = np.empty((len(commands), model.nq))
    for position, command in zip(positions, commands, strict=True):
        position[:] = data.qpos
        data.ctrl[:] = command
        for _ in range(steps):
            act(data)
            mujoco.mj_step(model, data)
    return positions


def write_log(folder, description, columns, runs, stem="log", **models):
    """Write a log with its description and model files; return the path of the log.

    Args:
        folder: folder of the files.
        description: text of the TOML file.
        columns: names of the signals after the time, separated by commas.
        runs: for each run, numbered from 1, columns (T,) or (T, N) from the time on; NaN is an
            empty cell.
        stem: name of the log.
        models: text of each model file NAME.xml by its name.
    """
    rows = [
        ",".join([str(number), *("" if np.isnan(value) else str(value) for value in row)])
        for number, run in enumerate(runs, start=1)
        for row in np.column_stack(run)
    ]
    path = folder / f"{stem}.csv"
    path.write_text("\n".join([f"run,t,{columns}", *rows]) + "\n")
    path.with_suffix(".toml").write_text(description)
    for name, text in models.items():
        (folder / f"{name}.xml").write_text(text)
    return path


def describe(units, noise=None, more="", model="arm"):
    """Return the description of a log.

    Args:
        units: unit of each signal by its name; names of inputs begin with ``u.``.
        noise: standard deviation of the noise of all channels, or of each by its name; None if it
            is not stated.
        more: further tables.
        model: name of the model file; without a suffix, that of an MJCF.
    """
    lines = [f'model = "{model if "." in model else f"{model}.xml"}"']
    for name, unit in units.items():
        is_input = name.startswith("u.")
        lines += [f'[{"inputs" if is_input else "channels"}."{name}"]', f'unit = "{unit}"']
        channel_noise = noise.get(name) if isinstance(noise, dict) else noise
        lines += [] if is_input or channel_noise is None else [f"noise = {channel_noise}"]
    return "\n".join([*lines, more])


SERVO_ARM = """<mujoco model="arm">
<option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="link">
  <joint name="hinge" axis="0 1 0" damping="0.1" armature="0.01"/>
  <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.8"/>
</body></worldbody>
<actuator><position name="servo" joint="hinge" kp="20" kv="1"/></actuator>
</mujoco>"""
"""Arm with one joint and a servo."""


def record_servo_arm(
    folder, model, seed=3, amplitudes=(0.9, 0.4), offset=0.0, lead=0.0, push=lambda data: 0.0
):
    """Record three runs of 3 s of a changed servo arm in plain MuJoCo, described by `SERVO_ARM`.

    Args:
        folder: folder of the log.
        model: compiled model, which may differ from `SERVO_ARM`.
        seed: seed of the phases and of the sensor noise of 1 mrad.
        amplitudes: amplitudes of the two sines of a command, in rad.
        offset: offset of the encoder, in rad.
        lead: kd / kp, in s, of a D term on the error; the controller computes the rate of the set
            point from its values at this time step and the last.
        push: function of MuJoCo's data that returns a torque at the joint, in N m.

    Returns:
        Path of the log.
    """
    step, gain = model.opt.timestep, model.actuator_gainprm[0, 0]
    rng, times, runs = np.random.default_rng(seed), 0.01 * np.arange(300), []
    for _ in range(3):
        phases = rng.uniform(0.0, 6.0, 2)
        commands = amplitudes[0] * np.sin(2.0 * times + phases[0])
        commands += amplitudes[1] * np.sin(5.1 * times + phases[1])

        def act(data, commands=commands):
            now, before = (
                commands[int(max(data.time - late, 0.0) / 0.01 + 1e-6)] for late in (0.0, step)
            )
            data.qfrc_applied[0] = push(data) + gain * lead * (now - before) / step

        readings = offset + follow(model, commands, 5, start=commands[0], act=act)
        runs.append((times, commands, readings + rng.normal(0.0, 1e-3, readings.shape)))
    description = describe({"u.servo": "rad", "q.hinge": "rad"}, 0.001)
    return write_log(folder, description, "u.servo,q.hinge", runs, arm=SERVO_ARM)
