"""Tune the PID baseline of a machine: the best that PID can do with a gain margin of 6 dB.

The gains (kp, ki, kd) of each joint minimise the largest tracking error over the machine's benchmark move with no,
half and full load, among all gains that still do not oscillate when they are doubled. A coarse grid, then a
finer one around the best.

Example: python tools/tune_pid.py --arm sil_plant/arms/reference.toml
"""

from __future__ import annotations

import argparse
import itertools
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__)

import numpy as np  # noqa: E402

from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.experiments.experiment import Outcome, setup_for, simulate  # noqa: E402
from sil_plant.inputs.machine import JOINT_NAMES, REFERENCE_ARM, Machine, load_machine, with_changes  # noqa: E402
from sil_plant.inputs.scenario import DEFAULT_SCENARIO, Scenario, load_profile, load_scenario, with_load  # noqa: E402

Gains = tuple[float, float, float]
MARGIN = 2.0
GRID_KP = (2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
GRID_KI_PER_KP = (0.0, 2.0, 4.0, 6.0, 9.0)
GRID_KD_PER_KP = (0.0, 0.005, 0.01)
FINE = (0.8, 0.9, 1.0, 1.1, 1.2)
# A joint rings when its error at rest, freed from the slow return to zero, swings by more than this.
RINGING_RAD = 2e-3
RINGING_TICKS = 400


def run(machine: Machine, scenario: Scenario, gains: list[Gains], load_kg: float) -> Outcome:
    """One run with these gains of swing and wrist."""
    changes = {}
    for joint, (kp, ki, kd) in zip(JOINT_NAMES, gains, strict=True):
        changes |= {
            f"control.{joint}.pid_kp": kp,
            f"control.{joint}.pid_ki": ki,
            f"control.{joint}.pid_kd": kd,
        }
    tuned = with_changes(machine, changes, "tune_pid")
    return simulate(setup_for(tuned, load_profile("paper"), with_load(scenario, load_kg), controller="pid"))


def calm(outcome: Outcome, joint: int) -> bool:
    """Whether a joint neither rang nor faulted, judged at rest at the end of the run."""
    record = outcome.session.record
    error = record.state[-RINGING_TICKS:, joint] - record.reference[-RINGING_TICKS:, joint]
    ticks = np.arange(RINGING_TICKS)
    slow = np.polyval(np.polyfit(ticks, error, 3), ticks)
    return not outcome.faulted and float(np.ptp(error - slow)) < RINGING_RAD


def score(machine: Machine, scenario: Scenario, gains: list[Gains], loads: list[float]) -> np.ndarray:
    """Worst peak error of swing and wrist, rad; infinite where a joint has no gain margin."""
    worst = np.zeros(2)
    for load in loads:
        outcome = run(machine, scenario, gains, load)
        doubled = [(MARGIN * kp, MARGIN * ki, MARGIN * kd) for kp, ki, kd in gains]
        margin = run(machine, scenario, doubled, load)
        for joint in range(2):
            good = calm(outcome, joint) and calm(margin, joint)
            worst[joint] = max(worst[joint], outcome.result.peak_err_rad[joint]) if good else np.inf
    return worst


def tune(machine: Machine, scenario: Scenario, loads: list[float]) -> tuple[list[Gains], np.ndarray]:
    """The best gains of both joints and their worst peak errors, rad."""
    best: list[Gains] = [(GRID_KP[0], 0.0, 0.0)] * 2
    errors = np.full(2, np.inf)
    coarse = [(kp, i * kp, d * kp) for kp, i, d in itertools.product(GRID_KP, GRID_KI_PER_KP, GRID_KD_PER_KP)]
    for candidates in (coarse, None):
        grids = [candidates or [(kp * f, ki * f * g, kd * f) for f in FINE for g in FINE] for kp, ki, kd in best]
        for pair in zip(*grids, strict=True):  # the joints are tried side by side; they hardly couple
            found = score(machine, scenario, list(pair), loads)
            for joint in range(2):
                if found[joint] < errors[joint]:
                    errors[joint], best[joint] = found[joint], pair[joint]
    return best, errors


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    parser = CommandLine(prog="tune_pid.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", type=Path, default=REFERENCE_ARM, metavar="FILE", help="machine file")
    parser.add_argument("--scenario", type=Path, default=DEFAULT_SCENARIO, metavar="FILE", help="benchmark move")
    parser.add_argument("--full-load", type=float, default=10.0, metavar="KG", help="the heaviest load; default 10")
    arguments = parser.parse_args(argv)
    try:
        machine, scenario = load_machine(arguments.arm), load_scenario(arguments.scenario)
        loads = [0.0, 0.5 * arguments.full_load, arguments.full_load]
        best, errors = tune(machine, scenario, loads)
    except (ConfigError, ValueError) as error:
        say(f"tune_pid.py: {error}")
        return 2
    for joint, name in enumerate(JOINT_NAMES):
        kp, ki, kd = best[joint]
        show(f"[control.{name}]   # worst peak error {1e3 * errors[joint]:.1f} mrad")
        show(f"pid_kp = {kp:.3g}\npid_ki = {ki:.3g}\npid_kd = {kd:.3g}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
