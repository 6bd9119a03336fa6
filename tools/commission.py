"""Commission a machine: move it without load, find every parameter but the load, store the set.

Examples
--------
  python tools/commission.py                                   in process, paper's plant
  python tools/commission.py --profile realistic -o out/arm.toml
  python tools/commission.py --bus vcan0 --ecu spawn           starts an ECU with the machine's parameters
  python tools/commission.py --bus can0 --save                 with an ECU that runs, which keeps what was found:
      ./firmware/diarc_ecu can0 --store arm.store

The move is made in the ECU's mode COMMISSION. Writes the set as TOML (run.py --params) and as parameter image
(diarc_ecu --params) beside it. Exit: 0 done; 1 the ECU failed or refused; 2 something has to be put right first.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__)

from sil_plant.bus import ecu_parameters  # noqa: E402
from sil_plant.bus.ports import BusAddress, BusError, parse_bus  # noqa: E402
from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.experiments import commissioning  # noqa: E402
from sil_plant.inputs.machine import REFERENCE_ARM, Machine, load_machine, parameter_image, with_changes  # noqa: E402
from sil_plant.inputs.scenario import PROFILE_NAMES, check_scenario, load_profile, load_scenario  # noqa: E402
from sil_plant.loop import bus_run, execution, session  # noqa: E402

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
    parser.add_argument("--save", action="store_true", help="also keep what was found in the ECU that found it")
    return parser.parse_args(argv)


def check_save(arguments: argparse.Namespace, address: BusAddress) -> None:
    """Refuse to save where no ECU stays that could keep it.

    Raises
    ------
    ConfigError
        Saying what can.
    """
    if not arguments.save:
        return
    if address.kind == "inproc" or arguments.ecu == "spawn":
        raise ConfigError("--save is for an ECU that stays: start one with --store FILE, and name its --bus")
    if address.kind == "slcan":
        raise ConfigError("--save needs a bus that two programs can share: vcan0, can0, tcp:HOST:PORT")


def move(
    arguments: argparse.Namespace, machine: Machine, finish: Callable[[session.Session, str | None], None]
) -> None:
    """Run the identification move; `finish` gets what was heard, and the bus while the ECU is still there."""
    address = parse_bus(arguments.bus)
    check_save(arguments, address)
    profile = load_profile(arguments.profile)
    scenario = load_scenario(arguments.scenario)
    check_scenario(scenario, machine)
    plant = with_changes(machine, profile.effects, f"profile {profile.name}")
    plant = commissioning.plant_when_commissioned(with_changes(plant, scenario.plant, str(arguments.scenario)))
    execution.compile_plant(machine, scenario)
    period_s = execution.PERIOD_US * 1e-6
    try:
        run = session.make_session(
            plant, scenario, "diarc", arguments.seed, period_s, profile.tare, session.REQUEST_COMMISSION
        )
    except ValueError as error:
        raise ConfigError(str(error)) from error
    image = parameter_image(machine)
    if address.kind == "inproc":
        execution.in_process(run, image, "double", lambda _: None)
        finish(run, None)
    else:
        pace = arguments.pace if arguments.ecu == "spawn" else None
        execution.over_bus(run, address, pace, image, lambda _: None, False, afterwards=lambda bus: finish(run, bus))


def found_in(run: session.Session, machine: Machine) -> list[commissioning.Finding]:
    """What the run has shown; printed, and good enough to be stored."""
    problem = execution.outcome(run, session.MODE_COMMISSION)
    if problem:
        raise bus_run.EcuLostError(problem)
    found = commissioning.findings(machine, run.monitor)
    show(commissioning.table(found))
    commissioning.check_excitation(found)
    return found


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    arguments = parse_arguments(argv)
    try:
        profile = load_profile(arguments.profile)
        plain = load_machine(arguments.arm)
        machine = with_changes(plain, profile.machine, f"profile {profile.name}")
        output = arguments.output or ROOT / "out" / f"{machine.name}.commissioned.toml"
        image = output.with_suffix(".params")
        if arguments.output is None:
            output.parent.mkdir(exist_ok=True)
        elif not output.resolve().parent.is_dir():
            raise ConfigError(f"{output}: its folder does not exist")

        def finish(run: session.Session, bus: str | None) -> None:
            found = found_in(run, machine)
            output.write_text(commissioning.to_toml(machine, found, profile.name), encoding="utf-8")
            image.write_bytes(parameter_image(commissioning.load_commissioned(output, machine)))
            show(f"\nwrote {output} for run.py --params, {image} for diarc_ecu --params")
            if arguments.save and bus is not None:
                with ecu_parameters.connect(bus) as ecu:
                    commissioning.save_in_ecu(ecu, machine, found)
                show(f"saved in the ECU on {bus}: it is used now, and at the next start, too")

        move(arguments, machine, finish)
    except (ConfigError, BusError, bus_run.EcuMissingError) as error:
        say(f"commission.py: {error}")
        return EXIT_WRONG_USE
    except ecu_parameters.RefusedError as error:
        say(f"commission.py: {error}")
        return EXIT_FAILED
    except bus_run.EcuLostError as error:
        say(f"commission.py: {error}; nothing was stored")
        return EXIT_FAILED
    except OSError as error:
        say(f"commission.py: {error.filename}: cannot be written: {error.strerror}")
        return EXIT_WRONG_USE
    except KeyboardInterrupt:
        say("commission.py: interrupted; nothing was stored")
        return EXIT_INTERRUPTED
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
