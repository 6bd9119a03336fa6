"""Commission a machine: move it without load, find every parameter but the load, store the set.

Examples
--------
  python tools/commission.py                                   in process, paper's plant
  python tools/commission.py --profile realistic -o out/arm.toml
  python tools/commission.py --bus vcan0 --ecu spawn           starts the ECU with commissioning priors
  python tools/commission.py --write-image commission.params   for an ECU that runs elsewhere:
      ./firmware/diarc_ecu can0 --params commission.params     then: python tools/commission.py --bus can0

Writes the set as TOML (run.py --params) and as parameter image (diarc_ecu --params) beside it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__)

from sil_plant import bus_run, commissioning, execution, session  # noqa: E402
from sil_plant.buses import BusError, parse_bus  # noqa: E402
from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.machine import REFERENCE_ARM, Machine, load_machine, parameter_image, with_changes  # noqa: E402
from sil_plant.scenario import PROFILE_NAMES, check_scenario, load_profile, load_scenario  # noqa: E402

EXIT_FAILED, EXIT_WRONG_USE, EXIT_INTERRUPTED = 1, 2, 130


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line; a wrong one ends the program with status 2."""
    parser = CommandLine(
        prog="commission.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arm", type=Path, default=REFERENCE_ARM, metavar="FILE", help="machine file")
    parser.add_argument("--profile", choices=PROFILE_NAMES, default="paper", help="how kind the plant is")
    parser.add_argument(
        "--scenario", type=Path, default=commissioning.COMMISSION_SCENARIO, metavar="FILE", help="the move"
    )
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the sensor noise")
    parser.add_argument("--bus", default="inproc", metavar="BUS", help="inproc (default), vcan0, tcp:HOST:PORT")
    parser.add_argument("--ecu", choices=("external", "spawn"), default="external")
    parser.add_argument("--pace", choices=("realtime", "strict", "lockstep"), default="realtime")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="default: out/MACHINE.commissioned.toml")
    parser.add_argument("--write-image", type=Path, metavar="FILE", help="write the commissioning image and stop")
    return parser.parse_args(argv)


def move(arguments: argparse.Namespace, machine: Machine) -> session.Session:
    """Run the identification move and return what was heard."""
    address = parse_bus(arguments.bus)
    profile = load_profile(arguments.profile)
    scenario = load_scenario(arguments.scenario)
    check_scenario(scenario, machine)
    plant = with_changes(machine, profile.effects, f"profile {profile.name}")
    plant = commissioning.plant_when_commissioned(with_changes(plant, scenario.plant, str(arguments.scenario)))
    execution.compile_plant(machine, scenario)
    try:
        run = session.make_session(plant, scenario, "diarc", arguments.seed, execution.PERIOD_US * 1e-6, profile.tare)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    image = parameter_image(commissioning.commissioning_machine(machine))
    if address.kind == "inproc":
        execution.in_process(run, image, "double", lambda _: None)
    else:
        pace = arguments.pace if arguments.ecu == "spawn" else None
        execution.over_bus(run, address, pace, image, lambda _: None, quiet=False)
    problem = execution.outcome(run)
    if problem:
        raise bus_run.EcuLostError(problem)
    return run


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    arguments = parse_arguments(argv)
    try:
        profile = load_profile(arguments.profile)
        plain = load_machine(arguments.arm)
        machine = with_changes(plain, profile.machine, f"profile {profile.name}")
        if arguments.write_image:
            arguments.write_image.write_bytes(parameter_image(commissioning.commissioning_machine(machine)))
            show(
                f"wrote {arguments.write_image}; start the ECU with it: diarc_ecu BUS --params {arguments.write_image}"
            )
            return 0
        output = arguments.output or ROOT / "out" / f"{machine.name}.commissioned.toml"
        if arguments.output is None:
            output.parent.mkdir(exist_ok=True)
        elif not output.resolve().parent.is_dir():
            raise ConfigError(f"{output}: its folder does not exist")
        run = move(arguments, machine)
        if abs(run.monitor.load[0]) > 0.0 or run.monitor.load[1] > 0.0:
            raise ConfigError(
                "the ECU estimates a load: it was not started with the commissioning image; make it with "
                "--write-image, or use --ecu spawn"
            )
        found = commissioning.findings(machine, run.monitor)
        show(commissioning.table(found))
        commissioning.check_excitation(found)
        output.write_text(commissioning.to_toml(machine, found, profile.name), encoding="utf-8")
        image = output.with_suffix(".params")
        image.write_bytes(parameter_image(commissioning.load_commissioned(output, machine)))
    except (ConfigError, BusError, bus_run.EcuMissingError) as error:
        say(f"commission.py: {error}")
        return EXIT_WRONG_USE
    except bus_run.EcuLostError as error:
        say(f"commission.py: {error}; nothing was stored")
        return EXIT_FAILED
    except OSError as error:
        say(f"commission.py: {error.filename}: cannot be written: {error.strerror}")
        return EXIT_WRONG_USE
    except KeyboardInterrupt:
        say("commission.py: interrupted; nothing was stored")
        return EXIT_INTERRUPTED
    show(f"\nwrote {output} for run.py --params, {image} for diarc_ecu --params")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
