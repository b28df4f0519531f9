"""A virtual bench for doses: cup, stream, receiver, balance and arm, simulated live and without a clock.

`VirtualDosingBench` is the ground truth for a controller that decides the tilt while liquid flows. It is deliberately
not the model of `actors.dosing.dose_estimator`:

| part | here |
|---|---|
| cup | a straight cylinder with a spout that protrudes beyond the rim, or with a round rim |
| onset | a dry lip holds the liquid back and gushes; a wet one holds less and dries slowly; grip error |
| flow | discharge that depends on the head, fluctuations, slosh, a film that drains late, drops |
| dribble | below a Weber number a part runs down the outside: half of it falls later, half is spilled |
| stream | falls from a height that changes, with initial speed, spread in time; its impact fluctuates |
| balance | first order, Butterworth of fourth order, moving average, switching lag; delay, display, noise; the |
|   | behaviours of real displays: `actors.balance.display_behaviour` |
| arm | commands at 10 or 20 Hz; limits of speed, acceleration and tilt, servo lag; back without news |

`DosingFault` disturbs a dose. Every dose is deterministic for a seed.

Limitations: one dimension; the liquid's surface is a plane plus one slosh mode. Orders of magnitude of dribble, film
and hold-back are from the literature that `sim_engine.model_validity` cites, not from measurements.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from actors.arm.arm_interface import NEWS_TIMEOUT
from actors.balance.display_behaviour import IDEAL, DisplayBehaviour, DisplayModel
from actors.dosing.dose_estimator import DoseReading
from actors.dosing.tilt_command import TiltCommand
from sim_engine.hydrostatics import GRAVITY
from sim_engine.liquids import Liquid

Floats = NDArray[np.float64]

TIME_STEP = 0.005
"""[s]"""

LONGEST_DOSE = 90.0
"""[s]"""

SPEED_LIMIT, ACCELERATION, RETURN_SPEED = math.radians(90.0), math.radians(600.0), math.radians(60.0)
"""Of the arm's tilt [rad/s], [rad/s²]; the last one without news, and at the end of a dose."""

SLOSH_MODE = 1.841
"""First zero of J₁', which gives the frequency of the first slosh mode of a deep cylinder (Ibrahim 2005)."""

SLOSH_DAMPING, SLOSH_LEVER = 0.08, 0.08
"""Damping of that mode per ω, and distance of the liquid from the axis of the tilt [m]."""

RECEIVER_RADIUS = 0.035
"""[m]"""


class Doser(Protocol):
    """Anything that decides the tilt of one dose."""

    def step(self, time: float, tilt: float, readings: Sequence[DoseReading]) -> TiltCommand | None:
        """Decide.

        Args:
            time: now [s].
            tilt: measured now [rad].
            readings: that arrived since the last call.

        Returns:
            The command; None if none reaches the arm.
        """
        ...


@dataclass(frozen=True)
class TrueCup:
    """A straight cylinder with its lip, as the virtual bench has it.

    Attributes:
        radius, height: of the cavity [m].
        spout_length: by which the spout protrudes beyond the rim; 0 for a round rim [m].
        spout_width: where it leaves the rim [m].
    """

    radius: float
    height: float
    spout_length: float = 0.0
    spout_width: float = 0.012

    @property
    def capacity(self) -> float:
        """[m³]"""
        return math.pi * self.radius**2 * self.height


@dataclass(frozen=True)
class TrueScale:
    """The balance under the receiver.

    Attributes:
        kind: of its filter.
        lag: of the filter, mean of its impulse response [s].
        interval: between two readings [s].
        delay: until a reading arrives [s].
        step: of the display [kg].
        noise: standard deviation before the display [kg].
        behaviour: how the display departs from an ideal one. A balance that tracks its zero is tared with the receiver
            on it before a dose, so that there is a zero to be tracked.
    """

    kind: Literal["first", "fourth", "average", "switching"] = "first"
    lag: float = 0.33
    interval: float = 0.1
    delay: float = 0.05
    step: float = 1e-4
    noise: float = 2e-5
    behaviour: DisplayBehaviour = IDEAL


@dataclass(frozen=True)
class Lip:
    """How a lip lets go of a stream.

    Attributes:
        critical_weber: Weber number below which a part of the stream clings to the outside.
        clinging: largest share that clings.
    """

    critical_weber: float
    clinging: float


SPOUT, ROUND_RIM = Lip(1.0, 0.25), Lip(3.0, 0.08)


@dataclass(frozen=True)
class DrainingFilm:
    """Liquid that stays on the wall for a while.

    Attributes:
        share: of what flows.
        time: constant with which it drains [s].
    """

    share: float
    time: float


THIN_FILM, THICK_FILM = DrainingFilm(0.03, 0.25), DrainingFilm(0.07, 0.7)
"""Of a thin and of a thick liquid."""


@dataclass(frozen=True)
class DosingFault:
    """A disturbance; `at` is the time after the first flow [s].

    Attributes:
        kind: 'knock' (5 g for 0.2 s), 'unstable' (the balance never rests), 'line cut' (no reading any more), 'stall'
            (the controller pauses for 0.7 s), 'killed' (it never comes back), 'miss' (the stream misses the receiver),
            'receiver missing', 'none'.
    """

    kind: Literal["knock", "unstable", "line cut", "stall", "killed", "miss", "receiver missing", "none"]
    at: float = 0.5

    def acts(self, kind: str, time: float, first_flow: float, lasting: float = math.inf) -> bool:
        """Whether a fault of this kind acts at a time [s], which lasts so long [s]."""
        return self.kind == kind and first_flow + self.at < time < first_flow + self.at + lasting

    def silences(self, time: float, first_flow: float) -> bool:
        """Whether the controller gives no command."""
        return self.acts("killed", time, first_flow) or self.acts("stall", time, first_flow, 0.7)

    def load(self, time: float, first_flow: float, normal: float) -> float:
        """What it adds to the load on the balance [kg]; `normal` is a standard normal number."""
        if self.kind == "knock" and 0.0 <= time - first_flow - self.at < 0.2:
            return 5e-3
        return 2e-3 * math.sin(8.0 * time) + 1e-3 * normal if self.kind == "unstable" else 0.0


NO_FAULT = DosingFault("none")


@dataclass(frozen=True)
class DoseRecord:
    """What truly happened in one dose.

    Attributes:
        received: in the receiver at the end [kg].
        spilled: next to it [kg].
        duration: from the first command to `finished` [s]; LONGEST_DOSE if it never came.
        stopped: time of the last outflow [s].
        upright: time at which the cup had turned back to its rest [s].
        times, tilts, true_mass, flow: signals (T,): [s], [rad], in the receiver [kg], past the lip [kg/s].
        readings: as the controller received them.
    """

    received: float
    spilled: float
    duration: float
    stopped: float
    upright: float
    times: Floats
    tilts: Floats
    true_mass: Floats
    flow: Floats
    readings: tuple[DoseReading, ...]


class _Table:
    """A function of two variables on an even grid, evaluated one value at a time."""

    def __init__(self, values: Floats, row_step: float, column_step: float) -> None:
        self._rows, self._row_step, self._column_step = values.tolist(), row_step, column_step
        self._last_row, self._last_column = len(values) - 2, values.shape[1] - 2

    def __call__(self, row: float, column: float) -> float:
        r, c = max(row / self._row_step, 0.0), max(column / self._column_step, 0.0)
        i, j = min(int(r), self._last_row), min(int(c), self._last_column)
        u, v = min(r - i, 1.0), min(c - j, 1.0)
        a, b = self._rows[i], self._rows[i + 1]
        low, high = a[j] + v * (a[j + 1] - a[j]), b[j] + v * (b[j + 1] - b[j])
        return float(low + u * (high - low))


_tables: dict[TrueCup, tuple[_Table, _Table]] = {}


def _tables_of(cup: TrueCup) -> tuple[_Table, _Table]:
    """Level above the lip over tilt and volume, and flow / C_d over tilt and the square root of the head."""
    if cup not in _tables:
        tilts = np.radians(np.arange(0.0, 126.0, 0.5))
        x = cup.radius * np.cos((np.arange(80) + 0.5) * math.pi / 80)
        # Cells of the cylinder: chord · dx · dz at (x, z), x = R cos t with even t, so that the ends are fine
        chord = 2.0 * np.sqrt(cup.radius**2 - x**2) * np.sqrt(cup.radius**2 - x**2) * math.pi / 80
        z = (np.arange(240) + 0.5) * cup.height / 240
        xs, zs = np.meshgrid(x, z, indexing="ij")
        each = np.repeat(chord[:, None], 240, axis=1).ravel() * cup.height / 240
        each *= cup.capacity / each.sum()
        volumes = np.linspace(0.0, cup.capacity, 201)
        levels, flows = [], []
        heads = np.linspace(0.0, math.sqrt(0.03), 80) ** 2
        s = 2.0 * cup.radius * ((np.arange(300) + 0.5) / 300) ** 2
        inside = np.clip(s - cup.spout_length, 0.0, 2.0 * cup.radius)
        width = 2.0 * np.sqrt(np.maximum(inside * (2.0 * cup.radius - inside), 0.0))
        if cup.spout_length > 0.0:
            width = np.maximum(width, cup.spout_width * np.sqrt(np.minimum(s / cup.spout_length, 1.0)))
        ds = np.gradient(s)
        # Height of a cell in the world: z cos θ − x sin θ. The surface of a volume V is the height below which cells of
        # the volume V lie; the flow is ∫ w √(2g (h − s sin θ)) ds.
        for tilt in tilts:
            heights = (zs * math.cos(tilt) - xs * math.sin(tilt)).ravel()
            order = np.argsort(heights)
            surface = np.interp(volumes, np.cumsum(each[order]), heights[order])
            lip = cup.height * math.cos(tilt) - (cup.radius + cup.spout_length) * math.sin(tilt)
            levels.append(surface - lip)
            depth = np.maximum(heads[:, None] - s * math.sin(tilt), 0.0)
            flows.append(np.sqrt(2.0 * GRAVITY * depth) @ (width * ds))
        _tables[cup] = (
            _Table(np.array(levels), math.radians(0.5), float(volumes[1])),
            _Table(np.array(flows), math.radians(0.5), math.sqrt(0.03) / 79),
        )
    return _tables[cup]


class _Filter:
    """The filter of a balance, in steps of `TIME_STEP`."""

    def __init__(self, scale: TrueScale, load: float) -> None:
        self._kind, self._lag = scale.kind, max(scale.lag, TIME_STEP)
        self.value = load
        self._states = [load, 0.0, load, 0.0]
        self._window: deque[float] = deque([load] * max(round(2.0 * self._lag / TIME_STEP), 1))
        self._sum = math.fsum(self._window)
        # delay of a Butterworth filter of fourth order at low frequencies: 2.613/ω
        self._omega = 2.613 / self._lag

    def step(self, load: float) -> float:
        """The value after one step with this load [kg]."""
        if self._kind == "average":
            self._sum += load - self._window.popleft()
            self._window.append(load)
            self.value = self._sum / len(self._window)
        elif self._kind == "fourth":
            # Two second-order sections s'' = ω² (u − s) − 2 ζ ω s', ζ = cos 22.5° and cos 67.5° (Butterworth 1930)
            for k, damping in ((0, 0.92388), (2, 0.38268)):
                s, w, source = self._states, self._omega, load if k == 0 else self._states[0]
                s[k + 1] += TIME_STEP * (w * w * (source - s[k]) - 2.0 * damping * w * s[k + 1])
                s[k] += TIME_STEP * s[k + 1]
            self.value = self._states[2]
        else:
            lag = self._lag
            if self._kind == "switching":
                lag *= 1.4 if abs(load - self.value) < 0.6e-3 else 0.8
            # exact first-order step: y += (u − y) (1 − e^(−dt/τ))
            self.value += (load - self.value) * -math.expm1(-TIME_STEP / lag)
        return self.value


class PouredLiquid(Protocol):
    """Liquid that leaves the cup of a bench and lands; see `LivePour`."""

    received: float
    spilled: float
    flow: float
    first_flow: float
    last_flow: float

    def step(self, tilt: float, turned: float, *, missed: bool = False) -> float:
        """Pour for one step of `TIME_STEP`. Returns the load on the balance, without the receiver [kg]."""
        ...

    def at_rest(self) -> float:
        """Mass in the receiver when everything has landed [kg]."""
        ...


class VirtualDosingBench:
    """One source vessel, one balance and one arm over a series of doses.

    Args:
        cup: the source vessel.
        liquid: in it; its mass is the first filling.
        scale: the balance.
        seed: of all randomness.
        receiver_mass: of an empty receiver [kg].
        command_interval: time between two calls of the controller [s].
        fall_height: from the lip to the bottom of the receiver [m].
        dose_seed: of all that differs between doses; None: of the whole series, as `seed`.
        wetness: of the lip at first, 0 … 1.
        held_tilt: by which the cup is held more tilted than the arm reports, besides what is drawn [rad].
        poured: makes the liquid of each dose; None: `LivePour`.

    Attributes:
        volume: in the source [m³].
        grip: tilt of the arm at which the cup is upright [rad].
        discharge: coefficient at a small head.
    """

    def __init__(
        self,
        cup: TrueCup,
        liquid: Liquid,
        scale: TrueScale,
        seed: int,
        *,
        receiver_mass: float = 0.18,
        command_interval: float = 0.05,
        fall_height: float = 0.15,
        dose_seed: int | None = None,
        wetness: float = 0.0,
        held_tilt: float = 0.0,
        poured: Callable[[VirtualDosingBench], PouredLiquid] | None = None,
    ) -> None:
        self.cup, self.liquid, self.scale = cup, liquid, scale
        self._poured = poured
        self.receiver_mass, self.fall_height = receiver_mass, fall_height
        self._interval = command_interval
        self._level, self._flow_table = _tables_of(cup)
        self._rng = np.random.default_rng((seed, 77))
        rng = self._rng
        self.volume = liquid.volume
        # constants of this bench, drawn once
        wets = 0.5 if liquid.is_thick else 1.0
        self.grip = math.radians(float(rng.normal(0.0, 0.4))) - held_tilt
        self._dry_hold = 1e-3 * wets * float(rng.uniform(0.8, 2.0))
        self._wet_hold = 1e-3 * wets * float(rng.uniform(0.1, 0.5))
        self.discharge = float(rng.normal(0.60, 0.04))
        self._wetness = wetness
        self._display_seed = (seed, 79) if dose_seed is None else (seed, 80, dose_seed)
        self._displays = 0
        self._servo_lag = float(rng.uniform(0.03, 0.06))
        self._network = float(rng.uniform(0.008, 0.025))
        if dose_seed is not None:
            self._rng = np.random.default_rng((seed, 78, dose_seed))

    def head(self, tilt: float, slosh: float) -> float:
        """Level above the lip at a tilt [rad] with slosh [m], less what the lip holds back [m]."""
        # Held back: (1 − wetness) dry + wetness wet [m]
        hold = self._dry_hold + (self._wet_hold - self._dry_hold) * self._wetness
        return self._level(tilt - self.grip, self.volume) + slosh - hold

    def ideal_flow(self, tilt: float, head: float) -> float:
        """Flow without losses at a tilt [rad] and a positive head [m] [m³/s]."""
        return self._flow_table(tilt, math.sqrt(head))

    def wet(self, flows: bool) -> None:
        """The lip gets wet in a step in which liquid flows; otherwise it dries slowly."""
        # w' = (1 − w) / 0.25 s while it flows, w' = −0.6 w / 40 s otherwise
        if flows:
            self._wetness += (1.0 - self._wetness) * TIME_STEP / 0.25
        else:
            self._wetness -= 0.6 * self._wetness * TIME_STEP / 40.0

    @property
    def content(self) -> float:
        """True content of the source [kg]."""
        return self.volume * self.liquid.density

    def refill(self, mass: float) -> None:
        """Fill the source to a mass [kg]; the lip dries meanwhile."""
        self.volume = mass / self.liquid.density
        self._wetness *= 0.3

    def place_receiver(self) -> tuple[DoseReading, ...]:
        """Put an empty receiver on the balance: readings of the step, until it rests, with arrival times from 0 [s]."""
        rng, scale = self._rng, self.scale
        placed, duration = 1.0 + float(rng.uniform(0.0, 0.3)), float(rng.uniform(0.03, 0.25))
        cell, end = _Filter(scale, 0.0), 1.5 + 8.0 * scale.lag + 0.5
        shown, readings, ask = self._display(0.0), [], 0.0
        for k in range(round(end / TIME_STEP)):
            time = k * TIME_STEP
            share = min(max((time - placed) / duration, 0.0), 1.0)
            shown.advance(cell.step(self.receiver_mass * share))
            if time >= ask:
                ask += scale.interval
                readings += shown.readings(time + scale.delay)
        self._wetness *= 0.85
        return tuple(readings)

    def dose(self, doser: Doser, fault: DosingFault = NO_FAULT) -> DoseRecord:
        """Run one dose into the empty receiver on the balance."""
        rng, scale = self._rng, self.scale
        base = 0.0 if fault.kind == "receiver missing" else self.receiver_mass
        cell, shown = _Filter(scale, base), self._display(base, zero=self.tare)
        drops = int(rng.integers(0, 4))
        arm = _TiltingArm(self._network, self._servo_lag)
        underway, delivered = deque[DoseReading](), list[DoseReading]()
        next_call, next_reading = 0.0, float(rng.uniform(0.0, scale.interval))
        finished_at, upright = math.inf, 0.0
        signals: list[tuple[float, float, float, float]] = []
        normals = rng.standard_normal(int(LONGEST_DOSE / TIME_STEP) * 2 + 20).tolist()
        pour: PouredLiquid = LivePour(self, drops, normals) if self._poured is None else self._poured(self)
        k, time = 0, 0.0
        while time < LONGEST_DOSE and time < finished_at + 2.5:
            # ---- controller and arm
            due = time >= next_call - 1e-9 and finished_at == math.inf
            if due and not fault.silences(time, pour.first_flow):
                next_call = time + self._interval
                arrived = []
                while underway and underway[0].time <= time:
                    arrived.append(underway.popleft())
                delivered += arrived
                command = doser.step(time, arm.tilt, arrived)
                if command is not None:
                    arm.order(time, command)
                    if command.finished:
                        finished_at = time
            lost = arm.without_news(time)
            if lost and fault.kind == "killed" and arm.tilt < 1e-4 and pour.first_flow < math.inf:
                finished_at = min(finished_at, time)
            turned = arm.step(returns=lost or finished_at < math.inf)
            if arm.tilt > 0.01:
                upright = time
            load = base + pour.step(arm.tilt, turned, missed=fault.acts("miss", time, pour.first_flow))
            # ---- balance
            load += fault.load(time, pour.first_flow, normals[2 * k + 1])
            shown.advance(cell.step(load))
            if time >= next_reading:
                next_reading += scale.interval + 0.005 * normals[2 * k + 1] * scale.interval / 0.1
                if not fault.acts("line cut", time, pour.first_flow):
                    underway += shown.readings(time + scale.delay)
            if k % 4 == 0:
                signals.append((time, arm.tilt, pour.received, pour.flow))
            k += 1
            time = k * TIME_STEP
        times, tilts, true_mass, flow = np.array(signals).T
        return DoseRecord(
            received=pour.at_rest(),
            spilled=pour.spilled,
            duration=min(finished_at, LONGEST_DOSE),
            stopped=0.0 if pour.last_flow == math.inf else pour.last_flow,
            upright=upright,
            times=times,
            tilts=tilts,
            true_mass=true_mass,
            flow=flow,
            readings=tuple(delivered),
        )

    @property
    def tare(self) -> float:
        """Load that the display shows as zero during a dose [kg]; only a zero can be tracked."""
        return self.receiver_mass if self.scale.behaviour.zero_tracking else 0.0

    def _display(self, load: float, zero: float = 0.0) -> _Display:
        """The display with a load at rest, and the load that it shows as zero [kg]."""
        self._displays += 1
        seed = (*self._display_seed, self._displays)
        return _Display(self.scale, self._rng, DisplayModel(self.scale.behaviour, self.scale.step, seed, load), zero)

    def pour(self) -> LivePour:
        """Liquid that follows a tilt from elsewhere, such as that of an emulated arm."""
        drops = int(self._rng.integers(0, 4))
        return LivePour(self, drops, self._rng.standard_normal(int(LONGEST_DOSE / TIME_STEP) * 2 + 20).tolist())


class _TiltingArm:
    """Follows commands that arrive late; without news it turns back.

    Args:
        network: time until a command arrives [s].
        servo_lag: of the tilt behind its target [s].

    Attributes:
        tilt: [rad].
    """

    def __init__(self, network: float, servo_lag: float) -> None:
        self._network, self._servo_lag = network, servo_lag
        self._underway: deque[tuple[float, TiltCommand]] = deque()
        self._command, self._arrived_at = TiltCommand(0.0), 0.0
        self._target = self._speed = 0.0
        self.tilt = 0.0

    def order(self, time: float, command: TiltCommand) -> None:
        """Send a command at a time [s]."""
        self._underway.append((time + self._network, command))

    def without_news(self, time: float) -> bool:
        """Receive what has arrived until a time [s]. Returns whether the last command is too old to be followed."""
        while self._underway and self._underway[0][0] <= time:
            _, self._command = self._underway.popleft()
            self._arrived_at = time
        return time - self._arrived_at > min(self._command.patience, NEWS_TIMEOUT)

    def step(self, *, returns: bool) -> float:
        """Move for one step of `TIME_STEP`, back or as commanded. Returns the change of the target's speed [rad/s]."""
        wanted = -RETURN_SPEED if returns else min(max(self._command.speed, -SPEED_LIMIT), SPEED_LIMIT)
        # v = √(2 a left): the speed from which the arm still stops at the command's largest tilt
        wanted = min(wanted, math.sqrt(2.0 * ACCELERATION * max(self._command.highest - self._target, 0.0)))
        before, most = self._speed, ACCELERATION * TIME_STEP
        self._speed += min(max(wanted - before, -most), most)
        self._target += self._speed * TIME_STEP
        if self._target < 0.0:
            self._target = self._speed = 0.0
        self.tilt += (self._target - self.tilt) * TIME_STEP / self._servo_lag  # first-order lag of the servo
        return self._speed - before


class LivePour:
    """Liquid that leaves the cup of a bench and lands, in steps of `TIME_STEP`.

    Args:
        bench: its cup and liquid, whose volume and wetness change.
        drops: number of late drops.
        normals: standard normal numbers, two for each step.

    Attributes:
        received, spilled: in the receiver and next to it [kg].
        flow: past the lip [kg/s].
        first_flow, last_flow: times of the first and the last outflow [s]; infinity before.
    """

    def __init__(self, bench: VirtualDosingBench, drops: int, normals: Sequence[float]) -> None:
        self._bench, self._drops, self._normals = bench, drops, normals
        self._landing = [0.0] * 120
        self._fluctuation = self._slosh = self._slosh_speed = self._film = self._late = 0.0
        self._k = 0
        self.received = self.spilled = self.flow = 0.0
        self.first_flow = self.last_flow = math.inf

    def step(self, tilt: float, turned: float, *, missed: bool = False) -> float:
        """Pour for one step.

        Args:
            tilt: of the cup [rad].
            turned: change of the tilt's speed in this step [rad/s].
            missed: the stream misses the receiver.

        Returns:
            Load on the balance, without the receiver [kg].
        """
        bench, k, dt = self._bench, self._k, TIME_STEP
        time, cup, liquid = k * dt, bench.cup, bench.liquid
        noise, kick = self._normals[2 * k % len(self._normals)], self._normals[(2 * k + 1) % len(self._normals)]
        density, nu, tension = liquid.density, liquid.kinematic_viscosity, liquid.surface_tension
        spouted = cup.spout_length > 0.0
        lip = SPOUT if spouted else ROUND_RIM
        film = THICK_FILM if liquid.is_thick else THIN_FILM
        omega = math.sqrt(SLOSH_MODE * GRAVITY / cup.radius)
        # ---- cup
        # First slosh mode of a deep cup: η'' + 0.08 ω η' + ω² η = −forcing by the tilt's acceleration; ω² = 1.841 g/R
        self._slosh_speed -= dt * (
            omega**2 * self._slosh
            + SLOSH_DAMPING * omega * self._slosh_speed
            + 0.5 * omega**2 * cup.radius * SLOSH_LEVER * turned / dt / GRAVITY
        )
        self._slosh += dt * self._slosh_speed
        head = bench.head(tilt, self._slosh)
        # Ornstein-Uhlenbeck process of the deviation 0.04 and the correlation time 0.3 s
        self._fluctuation += -self._fluctuation * dt / 0.3 + 0.04 * math.sqrt(2.0 * dt / 0.3) * noise
        outflow = 0.0
        if head > 0.0 and bench.volume > 0.0:
            ideal = bench.ideal_flow(tilt, head)
            wide = 2.0 * math.sqrt(2.0 * cup.radius * head)
            if spouted:
                wide = cup.spout_width * math.sqrt(min(head / cup.spout_length, 1.0))
            wide = max(wide, 1e-4)
            # q_i = C_d(h) q_ideal, q_v = 0.8 w g h³ / 3ν (Nusselt 1916), joined: q = q_i q_v / (q_i^1.5 +
            # q_v^1.5)^(2/3)
            outflow = (bench.discharge + 0.06 * math.tanh(head / 4e-3)) * ideal
            viscous = 0.8 * wide * GRAVITY * head**3 / (3.0 * nu)
            outflow = outflow * viscous / (outflow**1.5 + viscous**1.5) ** (1.0 / 1.5)
            outflow = min(outflow * (1.0 + self._fluctuation), bench.volume / dt)
            # We = ρ U² e / σ of the film e; below 1.5 times the critical number a part clings to the outside
            thickness = max(0.6 * head, 1e-5)
            weber = density * (outflow / (wide * thickness)) ** 2 * thickness / tension
            critical = lip.critical_weber
            clings = lip.clinging * min(max((1.5 * critical - weber) / critical, 0.0), 1.0)
            bench.wet(True)
            self.first_flow = min(self.first_flow, time)
        else:
            clings = 0.0
            bench.wet(False)
        bench.volume -= outflow * dt
        mass = density * outflow * dt
        # Half of what clings drips into the receiver with the time constant 0.8 s, half is spilled.
        clinging_mass = clings * mass
        self._late += 0.5 * clinging_mass - self._late * dt / 0.8
        self.spilled += 0.5 * clinging_mass
        self._film += film.share * mass
        drained = self._film * dt / film.time
        self._film -= drained
        leaves = (1.0 - film.share) * mass - clinging_mass + drained + self._late * dt / 0.8
        if mass == 0.0 and self.first_flow < math.inf and time > self.first_flow + 1.0 and self._drops and kick > 2.9:
            self._drops -= 1
            drop = min(5e-5, bench.volume * density)
            bench.volume -= drop / density
            leaves += drop
        if mass > 0.0:
            self.last_flow = time
        # ---- stream
        height = bench.fall_height - self.received / (density * math.pi * RECEIVER_RADIUS**2)
        fall = (math.sqrt(0.01 + 2.0 * GRAVITY * height) - 0.1) / GRAVITY
        # t_f = (√(v² + 2 g H) − v) / g with v = 0.1 m/s at the lip, and landing spread over three steps
        place = k + int(fall / dt) + (k % 3)
        self._landing[place % 120] += leaves
        lands = self._landing[k % 120]
        self._landing[k % 120] = 0.0
        if missed:
            self.spilled, lands = self.spilled + lands, 0.0
        self.received += lands
        # m' v / g [kg], v = √(0.1² + 2 g H) [m/s] at the surface
        impact = lands / dt * math.sqrt(0.01 + 2.0 * GRAVITY * height) / GRAVITY * (1.0 + 0.1 * kick)
        self.flow = leaves / dt
        self._k += 1
        return self.received + impact

    def at_rest(self) -> float:
        """Mass in the receiver when everything has landed [kg]."""
        return self.received + self._late * 0.5 + sum(self._landing)


class _Display:
    """Rounds, repeats, delays and loses readings, and reports when the value rests."""

    def __init__(self, scale: TrueScale, rng: np.random.Generator, model: DisplayModel, zero: float) -> None:
        self._scale, self._rng, self._model, self._zero = scale, rng, model, zero
        self._last: deque[float] = deque(maxlen=max(round(0.6 / scale.interval), 3))

    def advance(self, value: float) -> None:
        """Let one step of time pass, with this value of the filter [kg]."""
        self._model.advance(value, TIME_STEP, self._zero)

    def readings(self, due: float) -> list[DoseReading]:
        """The reading that is due then [s]; none if it is lost."""
        step = self._scale.step
        shown = self._model.show(self._new)
        self._last.append(shown)
        full = len(self._last) == self._last.maxlen
        stable = full and max(self._last) - min(self._last) < 1.5 * step
        return [] if self._model.loses() else [DoseReading(self._model.arrival(due), shown, stable)]

    def _new(self) -> float:
        step = self._scale.step
        value = self._model.value - self._zero + self._scale.noise * float(self._rng.standard_normal())
        return round(value / step) * step
