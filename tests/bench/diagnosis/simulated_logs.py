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
