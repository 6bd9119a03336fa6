"""Check a machine file before anything moves: keys and units, geometry, strength, flow, resonance, gains, limits.

Examples
--------
  python tools/check_arm.py sil_plant/arms/reference.toml
  python tools/check_arm.py crane.toml --scenario crane_moves.toml --load 100
  python tools/check_arm.py crane.toml --load 100 --propose            gains and limits for it, with reasons
  python tools/check_arm.py crane.toml --load 100 --write whole.toml   the file, what is missing filled in
  python tools/check_arm.py crane.toml --params crane.commissioned.toml --write known.toml    with what was found
  python tools/check_arm.py crane.toml --plots out                     lever arms, pressures, flow over the moves

Nothing is simulated: run.py does that. Exit: 0 it can work (notes and warnings are left), 1 it cannot, 2 wrong use.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import asdict
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # its threads cost more than such small matrices take

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__)

from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.design.check import Case, check_machine, make_case, with_lines  # noqa: E402
from sil_plant.design.machine_file import complete_text  # noqa: E402
from sil_plant.design.proposal import Proposal, as_toml, propose  # noqa: E402
from sil_plant.experiments.commissioning import load_commissioned  # noqa: E402
from sil_plant.inputs.machine import Machine  # noqa: E402
from sil_plant.inputs.machine_keys import (  # noqa: E402
    ERROR,
    NOTE,
    SEVERITIES,
    Finding,
    MachineKeys,
    is_proposed,
    read_keys,
    relation_findings,
)
from sil_plant.inputs.scenario import DEFAULT_SCENARIO, HEAVIEST_KG, Scenario, load_scenario  # noqa: E402
from sil_plant.loop.results import check_writable  # noqa: E402

EXIT_NOT_WORKING, EXIT_WRONG_USE = 1, 2


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line; a wrong one ends the program with status 2."""
    parser = CommandLine(prog="check_arm.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("machine", type=Path, metavar="MACHINE.toml")
    parser.add_argument(
        "--scenario", type=Path, default=DEFAULT_SCENARIO, metavar="FILE", help="the moves; default: the paper's"
    )
    parser.add_argument("--load", type=float, metavar="KG", help="the heaviest load; default: the scenario's heaviest")
    parser.add_argument("--propose", action="store_true", help="print bases, gains, limits and priors for this machine")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the file with what is missing filled in")
    parser.add_argument(
        "--params", type=Path, metavar="FILE", help="commissioned set from tools/commission.py, goes in"
    )
    parser.add_argument(
        "--plots", type=Path, metavar="FOLDER", help="draw lever arms, and pressures and flow in motion"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    return parser.parse_args(argv)


def full_load(arguments: argparse.Namespace, scenario: Scenario) -> float:
    """The heaviest load, kg."""
    if arguments.load is None:
        return max(step.load_kg for step in scenario.load)
    if not 0.0 <= arguments.load <= HEAVIEST_KG:
        raise ConfigError(f"--load {arguments.load:g}: 0 to {HEAVIEST_KG:g} kg is possible")
    return arguments.load


def check(
    arguments: argparse.Namespace, keys: MachineKeys, scenario: Scenario, load_kg: float
) -> tuple[list[Finding], dict[str, Proposal], Case | None]:
    """All findings, the proposals, and the case if the machine could be looked at as a whole.

    Values of a commissioned set count as proposals, too.
    """
    findings = [*keys.findings, *relation_findings(keys)]
    findings.sort(key=lambda f: "keys are missing" in f.what)  # what can be proposed comes last
    wrong = [f for f in findings if f.severity == ERROR]
    if keys.toml is None or not keys.physical_complete or any(not is_proposed(f.key) for f in wrong):
        return findings, {}, None
    missing = [key for key in keys.missing if is_proposed(key)]
    proposals: dict[str, Proposal] = {}
    if wrong or missing or arguments.propose or arguments.write:
        proposals = propose(keys.machine({}, arguments.machine), scenario, load_kg)
    only_missing = {f.key for f in keys.findings if "keys are missing" in f.what}
    if any(f.key not in only_missing for f in wrong):
        return findings, proposals, None
    machine: Machine = keys.machine({key: p.value for key, p in proposals.items()}, arguments.machine)
    if arguments.propose or arguments.write:  # what is missing is being proposed: no fault any more
        findings = [f for f in findings if f.key not in only_missing]
        if missing:
            what = f"{len(missing)} keys of {', '.join(only_missing)} are not in the file; the checks use proposals"
            findings.append(Finding(NOTE, "(file)", what))
    if arguments.params:
        known = load_commissioned(arguments.params, machine)
        found = {key: value for key, value in known.values.items() if value != machine.values[key]}
        proposals |= {key: Proposal(key, value, "commissioned") for key, value in found.items()}
        machine = known
    case = make_case(machine, scenario, load_kg)
    return findings + with_lines(check_machine(case), keys.line), proposals, case


def report(findings: list[Finding], header: str) -> str:
    """The findings for people, the worst first."""
    lines = [header]
    for severity in SEVERITIES:
        for f in findings:
            if f.severity == severity:
                where = f"{f.key} (line {f.line})" if f.line else f.key
                lines.append(f"{severity:<8} {where}: {f.what}")
                if f.advice:
                    lines.append(f"{'':8}   -> {f.advice}")
    return "\n".join(lines)


def verdict(findings: list[Finding], looked: bool) -> str:
    """The last line."""
    errors, warnings = (sum(f.severity == s for f in findings) for s in SEVERITIES[:2])
    counts = f"{errors} error{'s' * (errors != 1)}, {warnings} warning{'s' * (warnings != 1)}"
    if not looked:
        return f"{counts}; geometry, strength, flow and gains are looked at when these are put right"
    return f"{counts}: this machine {'will not work as it is' if errors else 'can work'}"


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    arguments = parse_arguments(argv)
    try:
        scenario = load_scenario(arguments.scenario)
        load_kg = full_load(arguments, scenario)
        keys = read_keys(arguments.machine)
        if arguments.write:
            check_writable(arguments.write)
        if arguments.plots and arguments.plots.exists() and not arguments.plots.is_dir():
            raise ConfigError(f"{arguments.plots}: is no folder")
        findings, proposals, case = check(arguments, keys, scenario, load_kg)
        written = outputs(arguments, keys, proposals, case)
    except ConfigError as error:
        say(f"check_arm.py: {error}")
        return EXIT_WRONG_USE
    failed = any(f.severity == ERROR for f in findings)
    if arguments.json:
        figures = {
            "file": str(arguments.machine),
            "machine": keys.name,
            "scenario": scenario.name,
            "load_kg": load_kg,
            "works": not failed,
            "checked_as_a_whole": case is not None,
            "findings": [asdict(f) for f in findings],
            "proposals": {key: asdict(p) for key, p in proposals.items()},
            "written": written,
        }
        show(json.dumps(figures, indent=2))
        return EXIT_NOT_WORKING if failed else 0
    header = f"{arguments.machine}: {keys.name}, moves of {scenario.name}, loads 0 to {load_kg:g} kg"
    show(report(findings, header))
    if arguments.propose and proposals:
        show(f"\n# Proposed for {keys.name}, {load_kg:g} kg, moves of {scenario.name}; paste what you want.")
        show(as_toml(proposals))
    for path in written:
        show(f"wrote {path}")
    show(verdict(findings, case is not None))
    if case is None and (arguments.write or arguments.plots or (arguments.propose and not proposals)):
        say("check_arm.py: nothing was proposed, written or drawn; put the errors right first")
    return EXIT_NOT_WORKING if failed else 0


def outputs(
    arguments: argparse.Namespace, keys: MachineKeys, proposals: dict[str, Proposal], case: Case | None
) -> list[str]:
    """Write what was asked for; the files."""
    written: list[str] = []
    if case is None:
        return written
    if arguments.write:
        wanted = {key: p for key, p in proposals.items() if key in keys.missing or p.reason == "commissioned"}
        text, kept = complete_text(keys, wanted)
        try:
            arguments.write.write_text(text, encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"{arguments.write}: cannot be written: {error.strerror}") from error
        if not kept:
            say(f"check_arm.py: note: the comments of {arguments.machine} could not be kept")
        written.append(str(arguments.write))
    if arguments.plots:
        from sil_plant.reports.machine_figures import write_plots  # matplotlib only when it is needed

        written += write_plots(case, arguments.plots)
    return written


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
