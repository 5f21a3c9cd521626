"""Time step, integrator and solver options of a robot: from its model file or a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict, cast

from sims.core import toml_validation
from sims.core.engine import IntegrationBatch, Trajectories
from sims.core.simulator import InputError, make_unknown_name_error
from sims.robot.parsing.floating_bases import fix_bases

if TYPE_CHECKING:
    from sims.robot.robot_model import RobotModel

INTEGRATOR_IDS = {"Euler": 0, "RK4": 1, "implicit": 2, "implicitfast": 3}
"""Numbers of MuJoCo's integrators (mjtIntegrator), by their names in a model file."""
RK4_INTEGRATOR_ID = INTEGRATOR_IDS["RK4"]
"""MuJoCo's number of the Runge-Kutta 4 integrator."""


CONE_IDS = {"pyramidal": 0, "elliptic": 1}
"""Numbers of MuJoCo's friction cones (mjtCone), by their names in a model file."""
SOLVER_IDS = {"PGS": 0, "CG": 1, "Newton": 2}
"""Numbers of MuJoCo's constraint solvers (mjtSolver), by their names in a model file."""
OPTION_WORDS: Mapping[str, Mapping[str, int]] = {
    "integrator": INTEGRATOR_IDS,
    "cone": CONE_IDS,
    "solver": SOLVER_IDS,
}
"""Numbers of the words that an option of a model file may have, by option."""
OPTION_EFFECTS: Mapping[str, str] = {
    "numerics.step": "timestep",
    "numerics.integrator": "integrator",
    "numerics.cone": "cone",
    "numerics.impratio": "impratio",
    "numerics.noslip": "noslip_iterations",
    "numerics.solver": "solver",
    "numerics.iterations": "iterations",
}
"""Options of a model file by the effect that names them as a cause."""


class IntegratorSettings(NamedTuple):
    """Numerical settings of MuJoCo.

    Attributes:
        timestep: time step in seconds.
        integrator: name of the integrator, a key of `INTEGRATOR_IDS`.
        solver_options: further options that differ from the model file, as pairs of name and
            number, sorted by name. They are those of `OPTION_EFFECTS`.
    """

    timestep: float
    integrator: str
    solver_options: tuple[tuple[str, float], ...] = ()

    def to_model_options(self) -> dict[str, float]:
        """Return the settings as fields of a model's options (`mujoco.MjOption`)."""
        return {
            "timestep": self.timestep,
            "integrator": INTEGRATOR_IDS[self.integrator],
            **dict(self.solver_options),
        }

    def to_document(self) -> dict[str, float | str]:
        """Return the settings as in a model file: words where the file has words."""
        return {
            name: format_option(name, number) for name, number in self.to_model_options().items()
        }

    def replace_options(self, options: Mapping[str, float]) -> IntegratorSettings:
        """Return the settings with other values of some options; all others keep theirs.

        Args:
            options: numbers by name of the option, as in `to_model_options`.
        """
        changed = {**self.to_model_options(), **options}
        integrator_names = {number: name for name, number in INTEGRATOR_IDS.items()}
        return IntegratorSettings(
            changed.pop("timestep"),
            integrator_names[int(changed.pop("integrator"))],
            # All options that remain are those of the solver.
            tuple(sorted(changed.items())),
        )


def format_option(name: str, number: float) -> float | str:
    """Return the value of an option as in a model file: a word where the file has words.

    Args:
        name: name of the option.
        number: its number in a compiled model.
    """
    words = {number: word for word, number in OPTION_WORDS.get(name, {}).items()}
    return words.get(int(number), number) if words else number


def parse_option(name: str, value: float | str) -> float:
    """Return the number of an option in a compiled model; the reverse of `format_option`."""
    return OPTION_WORDS[name][value] if isinstance(value, str) else value


def read_option(robot: RobotModel, name: str) -> float:
    """Return the number of an option in the robot's model file.

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        name: name of the option, such as ``impratio``.
    """
    return cast(float, getattr(robot.compiled.opt, name))


def list_changed_options(
    robot: RobotModel, settings: IntegratorSettings
) -> dict[str, tuple[float, float]]:
    """Return the options in which settings differ from the robot's model file.

    Args:
        robot: robot as read from its model file.
        settings: settings in use; solver options that they do not state are those of the file.

    Returns:
        Number in the file and number in use, by the effect that names the option, such as
        ``numerics.step``.
    """
    options = settings.to_model_options()
    return {
        effect: (file_number, options[name])
        for effect, name in OPTION_EFFECTS.items()
        if name in options and (file_number := read_option(robot, name)) != options[name]
    }


DEFAULT_SETTINGS = IntegratorSettings(0.002, "Euler")
"""MuJoCo's default settings."""


class RobotEngine:
    """MuJoCo at the time step of the model; `RobotSimulator` does the simulation."""

    name = "mujoco"

    def __init__(self, numerics: IntegratorSettings) -> None:
        self.numerics = numerics
        self.largest_step = numerics.timestep

    def integrate(self, batch: IntegrationBatch) -> Trajectories:
        """Raise an error: robots are simulated by `RobotSimulator`, not through this interface."""
        raise NotImplementedError

    def close(self) -> None:
        """Do nothing, since the engine holds no resources."""


def read_integrator_settings(robot: RobotModel) -> IntegratorSettings:
    """Return the integrator settings that the robot's model file specifies."""
    option = robot.compiled.opt
    names = {number: name for name, number in INTEGRATOR_IDS.items()}
    return IntegratorSettings(float(option.timestep), names[int(option.integrator)])


def specifies_integrator(robot: RobotModel) -> bool:
    """Return whether the user specified the time step and the integrator of the robot.

    An MJCF always does, since values that it omits are MuJoCo's defaults. A URDF describes the
    robot alone, unless it contains options of MuJoCo other than the defaults, or the table
    ``[engine]`` of the recording states them.

    Args:
        robot: robot as read from its model file.
    """
    # The table [engine] of the recording.
    is_stated = bool({"timestep", "integrator"} & set(robot.engine_table))
    is_default = read_integrator_settings(robot) == DEFAULT_SETTINGS
    return robot.format == "mjcf" or is_stated or not is_default


class EngineTable(TypedDict, total=False):
    """Table ``[engine]`` of a recording."""

    timestep: float
    integrator: str
    fix_base: bool
    recorded_bases: tuple[str, ...]


MIN_TIME_STEP, MAX_TIME_STEP = 1e-9, 1.0
"""Smallest and largest allowed time step, in seconds."""


def apply_engine_settings(spec: Any, table: Mapping[str, Any], source: str) -> list[str]:
    """Apply the table ``[engine]`` of a recording to a model: its time step, integrator and base.

    The entry ``recorded_bases`` is only checked here; `separate_floating_joints` applies it.

    Args:
        spec: a mujoco.MjSpec; it is changed in place.
        table: ``timestep`` in s, ``integrator`` by MuJoCo's name, and whether to ``fix_base``.
        source: beginning of error messages.

    Returns:
        Notes about the fixed bodies and omitted keyframes.

    Raises:
        InputError: the table is invalid.
    """
    settings = toml_validation.check_entries(
        source, "engine", table, toml_validation.get_type_hints_of(EngineTable)
    )
    if "timestep" in settings:
        step = toml_validation.check_finite(source, "engine.timestep", settings["timestep"])
        if not MIN_TIME_STEP <= step <= MAX_TIME_STEP:
            raise toml_validation.make_error(
                source, "engine.timestep", f"{MIN_TIME_STEP:g} to {MAX_TIME_STEP:g} s", step
            )
        spec.option.timestep = step
    if "integrator" in settings:
        name = settings["integrator"]
        if name not in INTEGRATOR_IDS:
            error = make_unknown_name_error("integrator", name, list(INTEGRATOR_IDS))
            raise InputError(f"{source}: engine: {error}")
        spec.option.integrator = INTEGRATOR_IDS[name]
    return fix_bases(spec) if settings.get("fix_base") else []


def with_integrator_settings(robot: RobotModel, settings: Mapping[str, float]) -> RobotModel:
    """Return the robot with other options of its model; the robot itself if they are equal.

    Args:
        robot: robot whose model has options already.
        settings: wanted options by name, such as ``timestep``, as numbers.
    """
    compiled_options = robot.compiled.opt
    if all(getattr(compiled_options, name) == value for name, value in settings.items()):
        return robot
    spec = robot.spec.copy()
    for name, value in settings.items():
        # An option that is an integer in the compiled model must be set to an integer.
        option_type = type(getattr(compiled_options, name))
        setattr(spec.option, name, option_type(value))
    return replace(robot, spec=spec)
