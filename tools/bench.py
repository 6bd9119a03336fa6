"""How fast the closed loop is, beside what else could simulate the arm: build/bench.json and build/bench.png.

All that is compared runs in this one run, in turns, and what counts are ratios of medians; other programs on the
computer slow all of it alike. Factors are seconds simulated per second of one core.

Example: python tools/bench.py --quick
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import multiprocessing
import os
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__)

from matplotlib.figure import Figure  # noqa: E402
from numba import njit  # noqa: E402
from scipy.integrate import solve_ivp  # noqa: E402

from sil_plant.bus import frames, protocol  # noqa: E402
from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.experiments.experiment import Setup, setup_for, simulate  # noqa: E402
from sil_plant.inputs.machine import REFERENCE_ARM, Machine, load_machine, parameter_image  # noqa: E402
from sil_plant.inputs.scenario import DEFAULT_SCENARIO, load_profile, load_scenario, with_load  # noqa: E402
from sil_plant.loop import inproc  # noqa: E402
from sil_plant.loop.execution import PERIOD_US  # noqa: E402
from sil_plant.loop.results import check_writable  # noqa: E402
from sil_plant.loop.session import Session, make_session, on_frame_plain, on_sync_plain  # noqa: E402
from sil_plant.plant.dynamics import LONGEST_STEP_S, P_SWING, STATES, XV, PlantParameters, derivative  # noqa: E402
from tools import plant_accuracy  # noqa: E402
from tools.plant_accuracy import CLASSIC, OURS, REFERENCE_STEP_S, Inputs  # noqa: E402

PERIOD_S = PERIOD_US * 1e-6
LOAD_KG = 2.5
ACCURACY_RAD = 1e-6  # asked for, of angles
TOLERANCES = tuple(10.0**-n for n in range(3, 11))
SCALE = np.array([1, 1, 1, 1, 1e6, 1e6, 1e6, 1e6, 1, 1, 1e2, 1e2])
MUJOCO = {"mujoco": "EULER", "mujoco_rk4": "RK4"}  # its default, and its exact one
SLOW_FROM = 200  # ticks; the slow ones are measured on a piece of the run in which the arm moves


# ---- the runs ---------------------------------------------------------------------------------------


def paper_run(duration_s: float = 10.0, machine: Machine | None = None) -> Setup:
    """The benchmark's move with a load."""
    machine = machine or load_machine(REFERENCE_ARM)
    moves = replace(load_scenario(DEFAULT_SCENARIO), duration_s=duration_s)
    return setup_for(machine, load_profile("paper"), with_load(moves, LOAD_KG))


def timed_run(setup: Setup) -> tuple[Session, float]:
    """A closed loop, and the processor's time for it, s."""
    session = make_session(setup.plant_machine, setup.scenario, setup.controller, setup.seed, PERIOD_S, setup.tare)
    ecu = inproc.InprocEcu(parameter_image(setup.machine), PERIOD_US, setup.scalar)
    start = time.process_time()
    inproc.run_inproc(session, ecu, len(session.noise) + 1)
    return session, time.process_time() - start


@njit(_nrt=False)
def hear_ecu(session, begin, end, ecu, sensors, counts, tx) -> None:
    """A closed loop that keeps what the ECU is sent in each tick."""
    for tick in range(counts.size):
        sent = begin(ecu, np.uintp(tx.ctypes.data), np.int32(inproc.TX_ROWS))
        rows = 0
        for k in range(sent):
            if frames.frame_id(tx[k]) == protocol.SYNC_ID:
                rows = on_sync_plain(session, int(tx[k, 5]), sensors[tick])
            else:
                on_frame_plain(session, tx[k])
        counts[tick] = rows
        at = np.uintp(sensors[tick].ctypes.data)
        sent = end(ecu, at, np.int32(rows), np.uintp(tx.ctypes.data), np.int32(inproc.TX_ROWS))
        for k in range(sent):
            on_frame_plain(session, tx[k])


@njit(_nrt=False)
def ecu_alone(begin, end, ecu, sensors, counts, tx) -> None:
    """The same ticks of the ECU without a plant."""
    for tick in range(counts.size):
        begin(ecu, np.uintp(tx.ctypes.data), np.int32(inproc.TX_ROWS))
        at = np.uintp(sensors[tick].ctypes.data)
        end(ecu, at, np.int32(counts[tick]), np.uintp(tx.ctypes.data), np.int32(inproc.TX_ROWS))


class EcuReplay:
    """Ticks of an ECU on the frames of a run that was."""

    def __init__(self, setup: Setup) -> None:
        self.image = parameter_image(setup.machine)
        session = make_session(setup.plant_machine, setup.scenario, setup.controller, setup.seed, PERIOD_S)
        ticks = len(session.noise)
        self.sensors = np.zeros((ticks, inproc.OUT_ROWS // 8, frames.FRAME_BYTES), dtype=np.uint8)
        self.counts = np.zeros(ticks, dtype=np.int64)
        self.tx = np.zeros((inproc.TX_ROWS, frames.FRAME_BYTES), dtype=np.uint8)
        ecu = inproc.InprocEcu(self.image, PERIOD_US, "double")
        hear_ecu(session, ecu.begin, ecu.end, np.uintp(ecu.pointer), self.sensors, self.counts, self.tx)
        self.seconds("double")  # compiles

    def seconds(self, scalar: str) -> float:
        """The processor's time for a tick of one number type, s."""
        ecu = inproc.InprocEcu(self.image, PERIOD_US, scalar)
        start = time.process_time()
        ecu_alone(ecu.begin, ecu.end, np.uintp(ecu.pointer), self.sensors, self.counts, self.tx)
        return (time.process_time() - start) / self.counts.size


# ---- others -----------------------------------------------------------------------------------------


def in_whole_ticks(inputs: Inputs, first: int, ticks: int, start: np.ndarray) -> Inputs:
    """A piece of a run with the inputs held for whole ticks: one piece of 1 ms each, the second of no length."""
    pieces = slice(2 * first, 2 * (first + ticks))
    duration = np.zeros(2 * ticks)
    duration[::2] = PERIOD_S
    u = np.repeat(inputs.u[pieces][1::2], 2, axis=0)
    return Inputs(first, u, inputs.load[pieces].copy(), duration, inputs.p_supply[pieces].copy(), start.copy())


def scipy_states(inputs: Inputs, p: PlantParameters, method: str, rtol: float) -> tuple[np.ndarray, float]:
    """States at every tick by SciPy on the compiled right-hand side, piece by piece, and time for a tick, s."""
    states, dy = [inputs.start.copy()], np.zeros(STATES)
    start = time.process_time()
    for k in range(0, len(inputs.load), 2):
        u, load = inputs.u[k], inputs.load[k]

        def rates(_: float, y: np.ndarray, u: np.ndarray = u, load: float = load) -> np.ndarray:
            derivative(y, u, load, p, dy)
            return dy.copy()

        solution = solve_ivp(rates, (0.0, PERIOD_S), states[-1], method=method, rtol=rtol, atol=rtol * 1e-2 * SCALE)
        states.append(solution.y[:, -1])
    return np.array(states), (time.process_time() - start) / (len(states) - 1)


def tolerance_for(inputs: Inputs, p: PlantParameters, method: str, exact: np.ndarray) -> tuple[float, float]:
    """The loosest tolerance that gives ACCURACY_RAD, and the error with it."""
    for rtol in TOLERANCES:
        states, _ = scipy_states(inputs, p, method, rtol)
        error = float(np.abs(states - exact)[:, :2].max())
        if error <= ACCURACY_RAD:
            break
    return rtol, error


def numpy_root(x: np.ndarray) -> np.ndarray:
    """The plant's root, for arrays."""
    ratio = x / 1e4
    return np.where(np.abs(x) >= 1e4, np.copysign(np.sqrt(np.abs(x)), x), 100.0 * ratio * (1.25 - 0.25 * ratio**2))


def numpy_rates(y: np.ndarray, u: np.ndarray, load_kg: float, p: PlantParameters) -> np.ndarray:
    """The paper's plant in plain numpy, both joints at once."""
    q, w, p1, p2, xv, xv_rate = y[0:2], y[2:4], y[4:8:2], y[5:8:2], y[8:10], y[10:12]
    triangle = q + p.q0
    length = np.sqrt(p.crank_a2_b2 - 2.0 * p.crank_ab * np.cos(triangle))
    lever = p.crank_ab * np.sin(triangle) / length
    x = length - p.x_offset
    volume1, volume2 = p.dead_volume + p.area1 * x, p.dead_volume + p.area2 * (p.stroke - x)
    extends = xv >= 0.0
    root_in = numpy_root(p.p_supply - np.where(extends, p1, p2))
    root_out = numpy_root(np.where(extends, p2, p1) - p.p_tank)
    flow1 = p.kv * xv * np.where(extends, root_in, root_out)
    flow2 = p.kv * xv * np.where(extends, root_out, root_in)
    leak = p.leakage * (p1 - p2)
    dy = np.empty(STATES)
    dy[0:2] = w
    dy[4:8:2] = p.bulk_modulus / volume1 * (-p.area1 * lever * w + flow1 - leak)
    dy[5:8:2] = p.bulk_modulus / volume2 * (p.area2 * lever * w - flow2 + leak)
    dy[8:10] = xv_rate
    dy[10:12] = p.valve_w**2 * (u - xv) - 2.0 * p.valve_damping * p.valve_w * xv_rate
    torque = lever * (p1 * p.area1 - p2 * p.area2) - p.fv * w - p.fc * 2.0 / np.pi * np.arctan(p.coulomb_slope * w)
    s, c = np.sin(q[1]), np.cos(q[1])
    r = p.L1 + p.L2 * c
    h = -p.L2 * s * (p.m2 * p.L1 + 2.0 * load_kg * r) - 2.0 * p.J * c * s
    dy[2] = (torque[0] - h * w[0] * w[1]) / (p.I1 + p.m2 * p.L1 * r + p.J * c * c + load_kg * r * r)
    gravity = p.g * p.L2 * c * (0.5 * p.m2 + load_kg)
    dy[3] = (torque[1] + 0.5 * h * w[0] ** 2 - gravity) / (p.J + load_kg * p.L2**2)
    return dy


def numpy_states(inputs: Inputs, p: PlantParameters) -> tuple[np.ndarray, float]:
    """States at every tick by classic Runge-Kutta in plain numpy at 250 us, and time for a tick, s."""
    h, y = PERIOD_S / 4, inputs.start.copy()
    states = [y]
    start = time.process_time()
    for k in range(0, len(inputs.load), 2):
        u, load = inputs.u[k], inputs.load[k]
        for _ in range(4):
            k1 = numpy_rates(y, u, load, p)
            k2 = numpy_rates(y + 0.5 * h * k1, u, load, p)
            k3 = numpy_rates(y + 0.5 * h * k2, u, load, p)
            k4 = numpy_rates(y + h * k3, u, load, p)
            y = y + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
            y[P_SWING:XV] = np.maximum(y[P_SWING:XV], 0.0)
        states.append(y)
    return np.array(states), (time.process_time() - start) / (len(states) - 1)


class Mujoco:
    """The same links and load in MuJoCo, the cylinders' forces of a run as its motors, viscous friction alone.

    The model is that of tests/sil/test_physics.py. ``mujoco.rollout`` steps it, so that no Python is in the loop.
    """

    def __init__(self, session: Session) -> None:
        import mujoco
        from mujoco import rollout

        file = ROOT / "tests" / "sil" / "test_physics.py"
        spec = importlib.util.spec_from_file_location("physics", file)
        assert spec and spec.loader
        physics = importlib.util.module_from_spec(spec)
        sys.modules["physics"] = physics
        spec.loader.exec_module(physics)
        self._mujoco, self._rollout = mujoco, rollout
        p, y = session.plant, session.record.state
        self.forces = y[:, 4:8:2] * p.area1 - y[:, 5:8:2] * p.area2
        arm = physics.MujocoArm()
        self.model, self.data = arm._model, arm._data
        half = np.sqrt(p.crank_a2_b2 + 2.0 * p.crank_ab), np.sqrt(p.crank_a2_b2 - 2.0 * p.crank_ab)
        crank_a, crank_b = 0.5 * (half[0] + half[1]), 0.5 * (half[0] - half[1])
        arm.accelerations(
            physics.RandomArm(
                g=p.g, I1=p.I1, L1=p.L1, L2=p.L2, m2=p.m2, J=p.J, load_kg=LOAD_KG, crank_a=crank_a, crank_b=crank_b,
                q0=p.q0, q=y[0, :2], w=y[0, 2:4], force=self.forces[0], friction=np.zeros(2),
            )
        )  # fmt: skip
        self.model.dof_damping[:] = p.fv
        self.start = np.zeros(mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        self.data.time = 0.0
        mujoco.mj_getState(self.model, self.data, self.start, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self.first = session.timeline.motion

    def states(self, step_s: float, ticks: int, integrator: str = "EULER") -> tuple[np.ndarray, float]:
        """Angles at every tick, and time for a tick, s."""
        steps = round(PERIOD_S / step_s)
        self.model.opt.integrator = getattr(self._mujoco.mjtIntegrator, f"mjINT_{integrator}")
        self.model.opt.timestep = step_s
        control = np.repeat(self.forces[:ticks], steps, axis=0)[np.newaxis]
        start = time.process_time()
        state, _ = self._rollout.rollout(self.model, self.data, self.start[np.newaxis], control)
        seconds = (time.process_time() - start) / ticks
        return state[0, steps - 1 :: steps, 1:3], seconds


# ---- processes --------------------------------------------------------------------------------------


def _runs(count: int) -> None:
    for _ in range(count):
        simulate(paper_run())


def _busy(count: int) -> None:
    for _ in range(count):
        sum(range(300_000))


def _work(task: str, count: int, ready: Any, go: Any, results: Any) -> None:
    simulate(paper_run(0.1))  # loads what is compiled
    ready.release()
    go.wait()
    start = time.perf_counter()
    (_runs if task == "runs" else _busy)(count)
    results.put((time.perf_counter() - start, _resident_bytes()))


def _resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def workers_seconds(task: str, workers: int, count: int) -> tuple[float, int]:
    """Wall time until every one of some processes has done ``count`` pieces, s, and the memory of all, bytes."""
    context = multiprocessing.get_context("spawn")
    ready, go, results = context.Semaphore(0), context.Event(), context.Queue()
    processes = [context.Process(target=_work, args=(task, count, ready, go, results)) for _ in range(workers)]
    for process in processes:
        process.start()
    try:
        for _ in processes:
            if not ready.acquire(timeout=120.0):
                raise ConfigError("a worker process did not start within 120 s")
        go.set()
        done = [results.get(timeout=120.0) for _ in processes]
    finally:
        for process in processes:
            process.join(5.0)
            process.kill()
    return max(t for t, _ in done), sum(m for _, m in done)


# ---- measuring --------------------------------------------------------------------------------------


def in_turns(measures: dict[str, Callable[[], float]], repetitions: int) -> dict[str, list[float]]:
    """Each measure so often, all of them in turns."""
    found: dict[str, list[float]] = {name: [] for name in measures}
    for _ in range(repetitions):
        for name, measure in measures.items():
            found[name].append(measure())
    return found


def nbytes(value: Any) -> int:
    """Bytes of all arrays in a tuple of tuples."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    return sum(nbytes(part) for part in value) if isinstance(value, tuple) else 0


def bench(quick: bool) -> dict[str, Any]:
    """Everything, as it is written to the JSON file."""
    repetitions, slow_ticks = (3, 40) if quick else (11, 300)
    setup = paper_run(2.0 if quick else 10.0)
    session, _ = timed_run(setup)
    p, inputs, ticks = session.plant, plant_accuracy.inputs_of(session), len(session.noise)
    ecu, mujoco = EcuReplay(setup), Mujoco(session)

    # what each is off by, with the same inputs
    exact, _ = plant_accuracy.states_of(inputs, p, CLASSIC, REFERENCE_STEP_S)
    ours, _ = plant_accuracy.states_of(inputs, p, OURS, LONGEST_STEP_S)
    piece = in_whole_ticks(inputs, SLOW_FROM, slow_ticks, session.record.state[SLOW_FROM])
    piece_exact, _ = plant_accuracy.states_of(piece, p, CLASSIC, REFERENCE_STEP_S)
    tolerance = {name: tolerance_for(piece, p, name, piece_exact) for name in ("RK45", "LSODA")}
    numpy_error = float(np.abs(numpy_states(piece, p)[0] - piece_exact)[:, :2].max())
    fine, _ = mujoco.states(LONGEST_STEP_S / 16, 1000, "RK4")
    mujoco_error = [
        float(np.abs(mujoco.states(LONGEST_STEP_S, 1000, integrator)[0] - fine).max()) for integrator in MUJOCO.values()
    ]

    seconds = in_turns(
        {
            "sil": lambda: timed_run(setup)[1] / ticks,
            **{
                name: (lambda integrator=integrator: mujoco.states(LONGEST_STEP_S, ticks, integrator)[1])
                for name, integrator in MUJOCO.items()
            },
            "scipy_rk45": lambda: scipy_states(piece, p, "RK45", tolerance["RK45"][0])[1],
            "scipy_lsoda": lambda: scipy_states(piece, p, "LSODA", tolerance["LSODA"][0])[1],
            "numpy": lambda: numpy_states(piece, p)[1],
            "plant": lambda: plant_accuracy.states_of(inputs, p, OURS, LONGEST_STEP_S)[1],
            **{f"ecu_{scalar}": (lambda scalar=scalar: ecu.seconds(scalar)) for scalar in inproc.SCALARS},
        },
        repetitions,
    )
    tick = {name: statistics.median(times) for name, times in seconds.items()}
    spread = {name: (max(times) - min(times)) / statistics.median(times) for name, times in seconds.items()}

    durations = (1.0, 2.0) if quick else (1.0, 2.0, 5.0, 10.0, 20.0, 40.0)
    counts = (1, 2) if quick else (1, 2, 4, 8, 16)
    growth_duration = []
    for duration in durations:
        times = [timed_run(paper_run(duration)) for _ in range(3)]
        growth_duration.append(
            {"duration_s": duration, "run_s": min(t for _, t in times), "session_bytes": nbytes(times[0][0])}
        )
    growth_runs = []
    for count in counts:
        start = time.process_time()
        _runs(count)
        growth_runs.append({"runs": count, "seconds": time.process_time() - start, "resident_bytes": _resident_bytes()})
    many, rounds = (4, 1) if quick else (40, 3)
    parallel: dict[str, dict[int, list[float]]] = {"runs": {1: [], 2: []}, "busy": {1: [], 2: []}}
    memory = {}
    for _ in range(rounds):
        for workers in (1, 2):
            for task in ("runs", "busy"):
                wall_s, memory[workers] = workers_seconds(task, workers, many)
                parallel[task][workers].append(wall_s)
    efficiency = {task: statistics.median(times[1]) / statistics.median(times[2]) for task, times in parallel.items()}
    factor = {name: PERIOD_S / tick[name] for name in NAMES}
    return {
        **{f"{name}_realtime_factor": value for name, value in factor.items()},
        "sil_over_mujoco": factor["sil"] / factor["mujoco"],
        "sil_over_scipy": factor["sil"] / max(factor["scipy_rk45"], factor["scipy_lsoda"]),
        "ecu_tick_ns": {scalar: 1e9 * tick[f"ecu_{scalar}"] for scalar in inproc.SCALARS},
        "plant_tick_ns": 1e9 * tick["plant"],
        "loop_tick_ns": 1e9 * tick["sil"],
        "share": {
            "ecu": tick["ecu_double"] / tick["sil"],
            "plant": tick["plant"] / tick["sil"],
            "frames_and_record": 1.0 - (tick["ecu_double"] + tick["plant"]) / tick["sil"],
        },
        "error_rad": {
            "sil": float(np.abs(ours - exact)[:, :2].max()),
            **dict(zip(MUJOCO, mujoco_error, strict=True)),
            "scipy_rk45": tolerance["RK45"][1],
            "scipy_lsoda": tolerance["LSODA"][1],
            "numpy": numpy_error,
        },
        "scipy_tolerance": {name: value for name, (value, _) in tolerance.items()},
        "campaign_efficiency_2_workers": efficiency["runs"],
        "busy_loop_efficiency_2_workers": efficiency["busy"],
        "growth": {
            "duration": growth_duration,
            "runs": growth_runs,
            "workers": [
                {"workers": n, "seconds": statistics.median(parallel["runs"][n]), "resident_bytes": memory[n]}
                for n in (1, 2)
            ],
        },
        "spread": spread,
        "repetitions": repetitions,
        "quick": quick,
    }


NAMES = {
    "sil": "closed loop: plant and ECU, in process",
    "mujoco": "MuJoCo (Euler), rigid links alone, same step",
    "mujoco_rk4": "MuJoCo (RK4), rigid links alone, same step",
    "scipy_lsoda": "SciPy LSODA, compiled right-hand side",
    "scipy_rk45": "SciPy RK45, compiled right-hand side",
    "numpy": "plain numpy, Runge-Kutta at 250 us",
}


def readme_table(result: dict[str, Any]) -> str:
    """The factors as Markdown, for tools/readme_tables.py."""
    rows = ["| 10 s of the reference arm, one core | times real time | worst angle error, rad |", "|---|---:|---:|"]
    for name, text in NAMES.items():
        factor = result[f"{name}_realtime_factor"]
        rows.append(f"| {text} | {factor:.3g} | {result['error_rad'][name]:.0e} |")
    ecu = ", ".join(f"{scalar} {ns:.0f}" for scalar, ns in result["ecu_tick_ns"].items())
    rows += ["", f"A tick of the plant takes {result['plant_tick_ns']:.0f} ns, one of the ECU (ns): {ecu}."]
    return "\n".join(rows)


def plot(result: dict[str, Any], path: Path) -> None:
    """Factors, shares of a tick, and growth."""
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    axes = figure.subplots(2, 2)
    names = list(NAMES)[::-1]
    factors = [result[f"{name}_realtime_factor"] for name in names]
    bars = axes[0, 0].barh([NAMES[name].split(",")[0] for name in names], factors, color="tab:blue")
    axes[0, 0].bar_label(
        bars, [f" {f:.3g}, {result['error_rad'][n]:.0e} rad" for f, n in zip(factors, names, strict=True)]
    )
    axes[0, 0].set(xscale="log", xlabel="times real time, and worst angle error", xlim=(None, max(factors) * 60))
    ns = {f"ECU, {k}": v for k, v in result["ecu_tick_ns"].items()}
    ns |= {"plant": result["plant_tick_ns"], "closed loop, double": result["loop_tick_ns"]}
    bars = axes[0, 1].barh(list(ns)[::-1], list(ns.values())[::-1], color="tab:green")
    axes[0, 1].bar_label(bars, fmt=" %.0f")
    axes[0, 1].set(xlabel="ns a tick", xlim=(0, 1.2 * max(ns.values())))
    growth = result["growth"]
    for axis, key, value, label in ((axes[1, 0], "duration", "run_s", "s"), (axes[1, 1], "runs", "seconds", "")):
        x = [row["duration_s" if key == "duration" else "runs"] for row in growth[key]]
        memory = [row["session_bytes" if key == "duration" else "resident_bytes"] / 2**20 for row in growth[key]]
        axis.plot(x, [row[value] for row in growth[key]], "o-", color="tab:blue")
        axis.set(xlabel=f"{key} {label}", ylabel="processor time, s", xlim=(0, None), ylim=(0, None))
        other = axis.twinx()
        other.plot(x, memory, "s--", color="tab:orange")
        other.set(ylabel="memory of the run, MiB" if key == "duration" else "memory of the process, MiB")
        other.set_ylim(0, 1.2 * max(memory))
    figure.savefig(path, dpi=110)


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    parser = CommandLine(prog="bench.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few repetitions and short runs, for a look and the tests")
    parser.add_argument("--json", type=Path, default=ROOT / "build" / "bench.json", metavar="FILE")
    arguments = parser.parse_args(argv)
    try:
        arguments.json.parent.mkdir(exist_ok=True)
        check_writable(arguments.json)
        result = bench(arguments.quick)
        arguments.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        plot(result, arguments.json.with_suffix(".png"))
    except ImportError as error:
        say(f"bench: {error}; MuJoCo's wheels begin with Python 3.11: make setup there")
        return 2
    except (ConfigError, OSError) as error:
        say(f"bench: {error}")
        return 2
    show(readme_table(result))
    two = f"{result['campaign_efficiency_2_workers']:.2f}"
    show(f"second worker: {two} (two independent busy loops: {result['busy_loop_efficiency_2_workers']:.2f})")
    worst = max(result["spread"].values())
    show(f"closed loop over MuJoCo {result['sil_over_mujoco']:.1f}, over SciPy {result['sil_over_scipy']:.0f}")
    show(f"spread of a measure at most {100 * worst:.0f} % of its median; wrote: {arguments.json}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
