"""How exact the plant's integrator is, and what others would cost: one table, for docs/speed.md.

Runs are made once, with the ECU in the loop. Then each integrator gets what the valves, the load and the supply did
in a run, tick by tick, and its states are compared with those of a reference: classic Runge-Kutta in steps of
REFERENCE_STEP_S, which tests/sil/test_plant.py compares with SciPy's DOP853.

Example: python tools/plant_accuracy.py --only paper
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__)

from numba import njit  # noqa: E402

from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.experiments.experiment import Setup, setup_for, simulate  # noqa: E402
from sil_plant.inputs.machine import REFERENCE_ARM, load_machine, with_changes  # noqa: E402
from sil_plant.inputs.scenario import DEFAULT_SCENARIO, load_profile, load_scenario, with_load  # noqa: E402
from sil_plant.loop import injection  # noqa: E402
from sil_plant.loop.session import Session  # noqa: E402
from sil_plant.plant.dynamics import LONGEST_STEP_S, P_SWING, STATES, XV, PlantParameters, derivative, integrate  # noqa: E402

REFERENCE_STEP_S = 1e-5
SCENARIOS = ROOT / "sil_plant" / "scenarios"
QUANTITIES = ("angle, rad", "rate, rad/s", "pressure, Pa", "spool")
_COLUMNS = (slice(0, 2), slice(2, 4), slice(P_SWING, XV), slice(XV, XV + 2))


OURS, CLASSIC = 0, 1

# ---- integrators -----------------------------------------------------------------------------------


@njit(cache=True, _nrt=False)
def classic(
    y: np.ndarray, u: np.ndarray, load_kg: float, p: PlantParameters, duration_s: float, step_s: float, work: np.ndarray
) -> None:
    """Classic Runge-Kutta on the whole right-hand side, in equal steps of at most ``step_s``."""
    steps = math.ceil(duration_s / step_s - 1e-9)
    if steps <= 0:
        return
    h = duration_s / steps
    k1, k2, k3, k4, z = work[0], work[1], work[2], work[3], work[4]
    for _ in range(steps):
        derivative(y, u, load_kg, p, k1)
        for n in range(STATES):
            z[n] = y[n] + 0.5 * h * k1[n]
        derivative(z, u, load_kg, p, k2)
        for n in range(STATES):
            z[n] = y[n] + 0.5 * h * k2[n]
        derivative(z, u, load_kg, p, k3)
        for n in range(STATES):
            z[n] = y[n] + h * k3[n]
        derivative(z, u, load_kg, p, k4)
        for n in range(STATES):
            y[n] += h / 6.0 * (k1[n] + 2.0 * (k2[n] + k3[n]) + k4[n])
        for n in range(P_SWING, XV):
            y[n] = max(y[n], 0.0)


@njit(cache=True, _nrt=False)
def advance(
    method: int,
    y: np.ndarray,
    u: np.ndarray,
    load: float,
    p: PlantParameters,
    duration_s: float,
    step_s: float,
    work: np.ndarray,
) -> None:
    """Move on by the plant's own integrator in steps of ``step_s``, or by the classic one."""
    if method == OURS:
        steps = math.ceil(duration_s / step_s - 1e-9)
        for _ in range(steps):
            integrate(y, u, load, p, duration_s / steps, work)
    else:
        classic(y, u, load, p, duration_s, step_s, work)


# ---- what happened in a run ------------------------------------------------------------------------


class Inputs(NamedTuple):
    """Pieces of constant input, each with its length."""

    first: int  # tick whose state they begin from
    u: np.ndarray  # (pieces, 2)
    load: np.ndarray
    duration_s: np.ndarray
    p_supply: np.ndarray
    start: np.ndarray


def inputs_of(session: Session) -> Inputs:
    """What the plant of a run was given, in two pieces for each tick."""
    record, timing, errors = session.record, session.timing, session.errors
    faults = injection.make_injection(
        (), 0, timing.period_s, 0, np.zeros((injection.RECOVERY_ROWS, 16), dtype=np.uint8)
    )
    faults = session.injection._replace(number=faults.number, count=faults.count)
    first = max(session.timeline.parked - 1, 0)
    follow = np.clip(np.zeros(2), *(record.valves[first, :2] + 0.5 * errors.hysteresis * s for s in (-1.0, 1.0)))
    pieces, p_supply, load = [], [], []
    for tick in range(first + 1):  # what faults keep from tick to tick
        injection.plant_now(faults, session.plant, tick, timing.period_s)
        injection.timing_now(faults, timing, tick)
    for tick in range(first + 1, len(record.state)):
        arm = injection.plant_now(faults, session.plant, tick, timing.period_s)
        now = injection.timing_now(faults, timing, tick)
        jitter = session.noise[tick, 7] * errors.jitter_s
        delay_s = min(max(now.delay_s + jitter, 0.0), now.period_s)
        pieces.append((*follow, delay_s))
        low, high = (record.valves[tick, :2] + 0.5 * errors.hysteresis * s for s in (-1.0, 1.0))
        follow = np.minimum(np.maximum(follow, low), high)
        pieces.append((*follow, now.period_s - delay_s))
        p_supply += [arm.p_supply] * 2
        load += [injection.load_now(faults, record.load_true[tick], tick)] * 2
    table = np.array(pieces)
    return Inputs(
        first, table[:, :2].copy(), np.array(load), table[:, 2].copy(), np.array(p_supply), record.state[first].copy()
    )


_P_SUPPLY = PlantParameters._fields.index("p_supply")
_AFTER = _P_SUPPLY + 1


@njit(cache=True, _nrt=False)
def replay(
    inputs: Inputs, p: PlantParameters, method: int, step_s: float, work: np.ndarray, states: np.ndarray
) -> None:
    """Write the states at the end of every second piece, shape (pieces / 2 + 1, 12)."""
    y = states[0]
    for n in range(STATES):
        y[n] = inputs.start[n]
    for tick in range(states.shape[0] - 1):
        for n in range(STATES):
            states[tick + 1, n] = states[tick, n]
        for k in range(2 * tick, 2 * tick + 2):
            now = PlantParameters(*(p[:_P_SUPPLY] + (inputs.p_supply[k],) + p[_AFTER:]))  # noqa: RUF005
            advance(method, states[tick + 1], inputs.u[k], inputs.load[k], now, inputs.duration_s[k], step_s, work)


def states_of(inputs: Inputs, p: PlantParameters, method: int, step_s: float) -> tuple[np.ndarray, float]:
    """States at every tick, and the processor's time for a tick, s."""
    states = np.zeros((len(inputs.load) // 2 + 1, STATES))
    start = time.process_time()
    replay(inputs, p, method, step_s, np.zeros((5, STATES)), states)
    return states, (time.process_time() - start) / (len(states) - 1)


# ---- the runs ---------------------------------------------------------------------------------------


def setups() -> dict[str, Setup]:
    """The runs by name."""
    reference, loader = load_machine(REFERENCE_ARM), load_machine(REFERENCE_ARM.with_name("loader.toml"))
    paper, realistic = load_profile("paper"), load_profile("realistic")
    moves = load_scenario(DEFAULT_SCENARIO)
    stiff = with_changes(reference, {"oil.bulk_modulus_Pa": 2.5e9}, "stiff oil")
    base = setup_for(reference, paper, with_load(moves, 2.5))
    return {
        "paper": base,
        "no load": setup_for(reference, paper, with_load(moves, 0.0)),
        "pid": setup_for(reference, paper, with_load(moves, 10.0), controller="pid"),
        "stiff oil": replace(base, machine=stiff, plant_machine=stiff),
        "realistic": setup_for(reference, realistic, with_load(moves, 2.5)),
        "realistic, no load": setup_for(reference, realistic, with_load(moves, 0.0)),
        "loader": setup_for(loader, paper, load_scenario(SCENARIOS / "loader.toml")),
        "loader, realistic": setup_for(loader, realistic, load_scenario(SCENARIOS / "loader.toml")),
        "faults": setup_for(reference, paper, load_scenario(SCENARIOS / "faults.toml")),
    }


def errors_of(states: np.ndarray, exact: np.ndarray) -> list[float]:
    """The worst difference of each of QUANTITIES."""
    return [float(np.abs(states[:, c] - exact[:, c]).max()) for c in _COLUMNS]


CANDIDATES = (
    ("classic Runge-Kutta, 250 us", CLASSIC, 2.5e-4),
    ("classic Runge-Kutta, 500 us", CLASSIC, 5e-4),
    ("the plant's, 500 us", OURS, 5e-4),
    ("the plant's, 250 us", OURS, 2.5e-4),
)


class Row(NamedTuple):
    """One integrator in one run."""

    run: str
    integrator: str
    tick_ns: float
    errors: list[float]


def measure(name: str, setup: Setup) -> list[Row]:
    """Every candidate in one run."""
    session = simulate(setup).session
    inputs = inputs_of(session)
    exact, _ = states_of(inputs, session.plant, CLASSIC, REFERENCE_STEP_S)
    rows = []
    for label, method, step_s in CANDIDATES:
        timed = [states_of(inputs, session.plant, method, step_s) for _ in range(3)]
        if (
            method == OURS
            and step_s == LONGEST_STEP_S
            and not np.array_equal(timed[0][0], session.record.state[inputs.first :])
        ):
            raise ConfigError(f"{name}: the replay is not what the run did")
        rows.append(Row(name, label, 1e9 * min(t for _, t in timed), errors_of(timed[0][0], exact)))
    return rows


def table(rows: list[Row]) -> str:
    """The rows as Markdown."""
    lines = ["| run | integrator | ns a tick | " + " | ".join(QUANTITIES) + " |", "|---" * 7 + "|"]
    for row in rows:
        errors = " | ".join(f"{e:.1e}" for e in row.errors)
        lines.append(f"| {row.run} | {row.integrator} | {row.tick_ns:.0f} | {errors} |")
    return "\n".join(lines)


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    runs = setups()
    parser = CommandLine(
        prog="plant_accuracy.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=tuple(runs), metavar="RUN", help=", ".join(runs))
    only = parser.parse_args(argv).only
    try:
        show(table([row for name in runs if only in (None, name) for row in measure(name, runs[name])]))
    except (ConfigError, OSError) as error:
        say(f"plant_accuracy: {error}")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
