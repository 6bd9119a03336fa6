"""Compare the number types: the same runs with the law in double, float and fixed point.

Prints the bars of the paper's profile for each type and the largest difference from double per signal.

In use:
  python tools/agreement.py                print the tables
  python tools/agreement.py --update       refresh them in docs/numbers.md too
  python tools/agreement.py --check        fail when float is past 1.05 or fixed past 1.5 times double
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__)

import numpy as np  # noqa: E402

from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.experiments.experiment import Outcome, commission, setup_for, simulate  # noqa: E402
from sil_plant.inputs.machine import REFERENCE_ARM, load_machine  # noqa: E402
from sil_plant.inputs.scenario import DEFAULT_SCENARIO, load_profile, load_scenario, with_load  # noqa: E402

DOCUMENT = ROOT / "docs" / "numbers.md"
BEGIN, END = "<!-- agreement: made by tools/agreement.py -->", "<!-- end of agreement -->"
SCALARS = ("double", "float", "fixed")
ALLOWED = {"double": 1.0, "float": 1.05, "fixed": 1.5}
LOADS_KG = (0.0, 2.5, 3.0, 5.0, 7.5, 10.0)
SEEDS = (1, 2, 3)
COMMISSION_SEED = 101
# Below this a figure is the sensors' resolution, and a ratio of two of them says nothing.
LEAST = {"load error, kg": 0.001, "settling, s": 0.01, "peak after 1 s, mrad": 0.005, "peak, mrad": 0.005}


def figures(outcome: Outcome) -> dict[str, float]:
    """The figures that the paper profile's bars are about; worst joint."""
    result = outcome.result
    settle = result.load_settle_s
    return {
        "load error, kg": abs(result.load_err_kg),
        "settling, s": np.inf if settle is None else settle,
        "peak after 1 s, mrad": 1e3 * max(v for v in result.peak_err_after_1s_rad if v is not None),
        "peak, mrad": 1e3 * max(result.peak_err_rad),
    }


def differences(outcome: Outcome, reference: Outcome) -> dict[str, float]:
    """Largest difference of each signal from the double run."""
    a, b = outcome.session.record, reference.session.record
    return {
        "joint angle, rad": float(np.abs(a.state[:, :2] - b.state[:, :2]).max()),
        "joint rate, rad/s": float(np.abs(a.state[:, 2:4] - b.state[:, 2:4]).max()),
        "pressure, Pa": float(np.abs(a.state[:, 4:8] - b.state[:, 4:8]).max()),
        "spool set-point, 1": float(np.abs(a.command - b.command).max()),
        "load estimate at the end, kg": float(abs(a.load_est[-1] - b.load_est[-1])),
        "its standard deviation at the end, kg": float(abs(a.load_sd[-1] - b.load_sd[-1])),
    }


def compare() -> tuple[dict[str, dict[str, float]], dict[str, dict[str, float]]]:
    """Worst figures per number type, and worst differences from double, over loads and seeds."""
    profile = load_profile("paper")
    machine, _ = commission(load_machine(REFERENCE_ARM), profile, COMMISSION_SEED)
    scenario = load_scenario(DEFAULT_SCENARIO)
    worst: dict[str, dict[str, float]] = {scalar: {} for scalar in SCALARS}
    apart: dict[str, dict[str, float]] = {scalar: {} for scalar in SCALARS[1:]}
    for load in LOADS_KG:
        for seed in SEEDS:
            runs = {
                scalar: simulate(setup_for(machine, profile, with_load(scenario, load), seed=seed, scalar=scalar))
                for scalar in SCALARS
            }
            for scalar, outcome in runs.items():
                for name, value in figures(outcome).items():
                    worst[scalar][name] = max(worst[scalar].get(name, 0.0), value)
            for scalar in SCALARS[1:]:
                for name, value in differences(runs[scalar], runs["double"]).items():
                    apart[scalar][name] = max(apart[scalar].get(name, 0.0), value)
    return worst, apart


def too_far(worst: dict[str, dict[str, float]]) -> list[str]:
    """What is past its allowance, in words."""
    found = []
    for scalar in SCALARS[1:]:
        for name, value in worst[scalar].items():
            allowed = ALLOWED[scalar] * max(worst["double"][name], LEAST[name])
            if not value <= allowed:
                found.append(f"{scalar}: {name} is {value:.4g}, at most {allowed:.4g} is allowed")
    return found


def tables(worst: dict[str, dict[str, float]], apart: dict[str, dict[str, float]]) -> str:
    """Both tables in Markdown."""
    lines = ["| worst over loads and seeds | " + " | ".join(SCALARS) + " |", "|---|" + "---|" * len(SCALARS)]
    for name in worst["double"]:
        lines.append(f"| {name} | " + " | ".join(f"{worst[scalar][name]:.4g}" for scalar in SCALARS) + " |")
    lines += ["", "| largest difference from double | " + " | ".join(SCALARS[1:]) + " |", "|---|---|---|"]
    for name in apart["float"]:
        lines.append(f"| {name} | " + " | ".join(f"{apart[scalar][name]:.2g}" for scalar in SCALARS[1:]) + " |")
    return "\n".join(lines)


def update_document(text: str) -> None:
    """Put the tables between the markers of docs/numbers.md."""
    document = DOCUMENT.read_text(encoding="utf-8")
    if BEGIN not in document or END not in document:
        raise ConfigError(f"{DOCUMENT.relative_to(ROOT)}: the markers of the tables are missing")
    before, rest = document.split(BEGIN, 1)
    after = rest.split(END, 1)[1]
    DOCUMENT.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    parser = CommandLine(prog="agreement.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--update", action="store_true", help="refresh docs/numbers.md")
    parser.add_argument("--check", action="store_true", help="exit 1 when a type is too far from double")
    arguments = parser.parse_args(argv)
    try:
        worst, apart = compare()
        text = tables(worst, apart)
        show(text)
        if arguments.update:
            update_document(text)
    except (ConfigError, OSError) as error:
        say(f"agreement.py: {error}")
        return 2
    found = too_far(worst)
    for line in found:
        say(f"agreement.py: {line}")
    return 1 if found and arguments.check else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
