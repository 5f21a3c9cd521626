"""Independent SciPy implementation of the systems and effects, the reference for the batch engine.

It uses nothing of the code under test except its scenarios, and simulates one batch element at a
time. Motion between events is integrated by an explicit method of eighth order (DOP853, rtol 1e-9,
atol 1e-11); impacts, standstill and break-away are events.
"""

import bisect
from dataclasses import dataclass, field
from math import copysign, cos, exp, pi, sin

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

SETTINGS = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-11}
OVER = 1e-6  # m/s: slower rebounds are ignored


@dataclass
class Case:
    """One batch element.

    Attributes:
        system: its name.
        parameters, constants, initial: by name.
        effects: coefficients by the effect's name, in order.
        t: (T,) samples.
        inputs: commands by name, (T,).
    """

    system: str
    parameters: dict
    constants: dict
    initial: dict
    effects: dict
    t: np.ndarray
    inputs: dict = field(default_factory=dict)


def held(case, name, t):
    """Return the zero-order-hold command at time t."""
    return float(case.inputs[name][max(bisect.bisect_right(case.t, t) - 1, 0)])


def dead(u, width):
    return u - min(max(u, -width), width)


class Plant:
    """Forces of one batch element: `pull` without dry friction, `limit` the maximum dry
    friction.
    """

    def __init__(self, case):
        self.case, self.k, self.p = case, case.constants, case.parameters
        self.effects = {name: np.atleast_1d(c).tolist() for name, c in case.effects.items()}
        self.dry = any(name.startswith("friction.") for name in self.effects)
        self.names = list(case.inputs)
        self.mass = {
            "ball": lambda: 1.0,
            "pendulum": lambda: self.p["inertia"],
            "slider": lambda: self.p["mass"],
            "servo": lambda: self.p["armature"] + self.k["mass"] * self.k["length"] ** 2,
        }[case.system]()
        self.felt = None
        delay = self.effects.get("input.delay", [0.0])[0]
        self.breaks = set()
        for place, name in enumerate(self.names):
            there = case.t[1:][np.diff(case.inputs[name]) != 0]
            self.breaks |= set((there + (delay if place == 0 else 0.0)).tolist())

    def feel(self, t):
        """Compute the applied inputs at t and set them for the following calls."""
        values = []
        for place, name in enumerate(self.names):
            shift = self.effects.get("input.delay", [0.0])[0] if place == 0 else 0.0
            u = held(self.case, name, t - shift)
            if place == 0 and "input.hold" in self.effects:
                straight = np.interp(t - shift, self.case.t, self.case.inputs[name])
                u += self.effects["input.hold"][0] * (straight - u)
            for effect, c in self.effects.items() if place == 0 else ():
                if effect == "input.gain":
                    u *= 1.0 + c[0]
                elif effect == "input.bias":
                    u += c[0]
                elif effect == "input.deadband":
                    u = dead(u, c[0])
                elif effect == "input.saturation":
                    u = min(max(u, -c[0]), c[0])
            values.append(u)
        self.felt = values

    def drive(self, x, v):
        p, k = self.p, self.k
        if self.case.system == "servo":
            if self.felt[1] <= 0.5:
                return 0.0
            duty = min(max(k["kp"] * k["error_gain"] * (self.felt[0] - x), -1.0), 1.0)
            return (
                p["torque_constant"]
                * (duty * k["voltage"] - p["torque_constant"] * v)
                / p["resistance"]
            )
        return self.felt[0]

    def weight(self, x):
        if self.case.system == "slider":
            return 0.0
        return -self.k["mass"] * self.k["gravity"] * self.k["length"] * sin(x)

    def sideways(self, x):
        """Return the generalised force of a horizontal acceleration of 1."""
        if self.case.system == "slider":
            return self.mass
        return self.k["mass"] * self.k["length"] * cos(x)

    def pull(self, t, x, v):
        drive, weight = self.drive(x, v), self.weight(x)
        total = drive + weight
        for name, c in self.effects.items():
            if name == "drag.linear":
                total -= c[0] * v
            elif name == "drag.quadratic":
                total -= c[0] * abs(v) * v
            elif name == "gravity.scale":
                total += c[0] * weight
            elif name == "gravity.tilt":
                total += self.k.get("gravity", 9.80665) * c[0] * self.sideways(x)
            elif name == "spring.linear":
                total -= c[0] * x
            elif name == "spring.cubic":
                total -= c[0] * x**3
            elif name == "force.bias":
                total += c[0]
            elif name == "force.ripple":
                total += c[0] * sin(2 * pi * x / c[2]) + c[1] * cos(2 * pi * x / c[2])
            elif name == "force.periodic":
                total += c[0] * sin(2 * pi * c[2] * t) + c[1] * cos(2 * pi * c[2] * t)
            elif name == "wind":
                total -= c[0] * abs(v - c[1]) * (v - c[1])
        return total

    def limit(self, x, v):
        total = 0.0
        for name, c in self.effects.items():
            if name == "friction.coulomb":
                total += c[0]
            elif name == "friction.stribeck":
                total += c[0] + c[1] * exp(-((v / c[2]) ** 2))
            elif name == "friction.load":
                total += c[0] * abs(self.drive(x, v) - self.weight(x))
        return total


def hinge(case):
    """Return positions and velocities (T, 2) of a system with one coordinate."""
    plant = Plant(case)
    now, state = 0.0, np.array([case.initial["x"], case.initial["v"]])
    out = np.empty((case.t.size, 2))
    out[0] = state
    ends = sorted({b for b in plant.breaks if 0 < b < case.t[-1]} | {float(case.t[-1])})
    for end in ends:
        plant.feel(0.5 * (now + end))
        while now < end:
            now, state = _glide(plant, now, state, end, case.t, out)
    return out


def _glide(plant, now, state, end, times, out):
    """Integrate to the next standstill, break-away or `end`; fill in the samples on the way."""
    x, v = state
    way = copysign(1.0, v) if v else 0.0
    if plant.dry and v == 0.0:
        pull = plant.pull(now, x, 0.0)
        if abs(pull) <= plant.limit(x, 0.0):
            loose = _loose(plant, now, x, end)
            out[(times > now) & (times <= loose)] = state
            return loose, state
        way = copysign(1.0, pull)

    def rate(t, y):
        rubbing = way * plant.limit(y[0], y[1]) if plant.dry else 0.0
        return y[1], (plant.pull(t, y[0], y[1]) - rubbing) / plant.mass

    def turns(t, y):
        return way * y[1]

    turns.terminal, turns.direction = True, -1
    solved = solve_ivp(
        rate,
        (now, end),
        state,
        events=turns if plant.dry else None,
        dense_output=True,
        max_step=0.05,
        **SETTINGS,
    )
    assert solved.success
    inside = (times > now) & (times <= solved.t[-1])
    if inside.any():
        out[inside] = solved.sol(times[inside]).T
    state = solved.y[:, -1].copy()
    if plant.dry and solved.t_events[0].size:
        state[1] = 0.0
    return float(solved.t[-1]), state


def _loose(plant, now, x, end):
    """Return the time at which the driving force exceeds friction, or `end`."""
    if "force.periodic" not in plant.effects:
        return end

    def excess(t):
        return abs(plant.pull(t, x, 0.0)) - plant.limit(x, 0.0)

    grid = np.linspace(now, end, 2000)
    values = np.array([excess(t) for t in grid])
    over = np.flatnonzero(values > 0)
    if not over.size:
        return end
    return brentq(excess, grid[over[0] - 1], grid[over[0]], xtol=1e-14) + 1e-13


def ball(case):
    """Return positions, velocities and accelerations (T, 9) of the ball, and the impact times."""
    effects = {name: np.atleast_1d(c).tolist() for name, c in case.effects.items()}
    g, radius = case.constants["gravity"], case.constants["radius"]

    def accelerate(t, v):
        a = np.array([0.0, 0.0, -g])
        for name, c in effects.items():
            if name == "drag.linear":
                a -= c[0] * v
            elif name == "drag.quadratic":
                a -= c[0] * np.linalg.norm(v) * v
            elif name == "wind":
                relative = v - [c[1], c[2], 0.0]
                a -= c[0] * np.linalg.norm(relative) * relative
            elif name == "gravity.scale":
                a[2] -= c[0] * g
            elif name == "gravity.tilt":
                a[:2] += g * c[0], g * c[1]
            elif name == "force.bias":
                a[2] += c[0]
            elif name == "force.periodic":
                a[2] += c[0] * sin(2 * pi * c[2] * t) + c[1] * cos(2 * pi * c[2] * t)
            elif name == "lift.magnus":
                a += np.cross([0.0, -c[0], c[1]], v)
        return a

    resting = False

    def rate(t, y):
        a = accelerate(t, y[3:])
        if resting:
            a[2] = max(a[2], 0.0)
        return np.concatenate([y[3:], a])

    def meets(t, y):
        return y[2] - radius

    meets.terminal, meets.direction = True, -1
    now, y, end = 0.0, np.array(case.initial, dtype=float), float(case.t[-1])
    out, impacts = np.empty((case.t.size, 9)), []
    out[0, :6], out[0, 6:] = y, accelerate(0.0, y[3:])
    rising = 0.0
    while now < end:
        # The rise after a bounce starts on the ground, so it is integrated without the ground
        # event.
        until = min(end, now + rising) if rising else end
        solved = solve_ivp(
            rate,
            (now, until),
            y,
            events=None if rising or resting else meets,
            dense_output=True,
            **SETTINGS,
        )
        assert solved.success
        inside = (case.t > now) & (case.t <= solved.t[-1])
        if inside.any():
            states = solved.sol(case.t[inside]).T
            out[inside, :6] = states
            out[inside, 6:] = [rate(t, s)[3:] for t, s in zip(case.t[inside], states, strict=True)]
        now, y = float(solved.t[-1]), solved.y[:, -1].copy()
        if rising or resting or not solved.t_events[0].size:
            rising = 0.0
            continue
        impacts.append(now)
        y, resting = _bounce(y, case.parameters["restitution"], effects)
        y[2] = radius
        rising = 0.0 if resting else 0.5 * y[5] / max(-accelerate(now, y[3:])[2], 1e-3)
    return out, np.array(impacts)


def _bounce(y, restitution, effects):
    speed = -y[5]
    if "restitution.speed" in effects:
        restitution = min(restitution * speed ** effects["restitution.speed"][0], 1.0)
    y = y.copy()
    y[5] = restitution * speed
    along = np.hypot(y[3], y[4])
    lost = effects.get("contact.friction", [0.0])[0] * (1 + restitution) * speed
    if along > 0:
        y[3:5] *= max(1.0 - lost / along, 0.0)
    if y[5] < OVER:
        y[5] = 0.0
        return y, True
    return y, False
