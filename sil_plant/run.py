"""Run the simulated arm against the ECU: on a CAN bus, over TCP, or in this process.

Examples
--------
  ./firmware/diarc_ecu vcan0 &  python sil_plant/run.py --load 2.5
  python sil_plant/run.py --load 2.5 --bus tcp:127.0.0.1:29536 --ecu spawn
  python sil_plant/run.py --load 2.5 --bus inproc --json result.json --csv trace.csv
  python sil_plant/run.py --bus inproc --fmu machine.fmu --map machine.toml
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__)

from rich.console import Console  # noqa: E402
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn  # noqa: E402

from sil_plant.bus import protocol  # noqa: E402
from sil_plant.bus.ports import BusAddress, BusError, parse_bus  # noqa: E402
from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.experiments.commissioning import load_commissioned  # noqa: E402
from sil_plant.inputs.faults import Fault  # noqa: E402
from sil_plant.inputs.machine import REFERENCE_ARM, Machine, load_machine, parameter_image, with_changes  # noqa: E402
from sil_plant.inputs.scenario import (  # noqa: E402
    DEFAULT_SCENARIO,
    LONGEST_RUN_S,
    PROFILE_NAMES,
    Scenario,
    check_scenario,
    load_profile,
    load_scenario,
    with_load,
)
from sil_plant.loop import bus_run, execution, inproc, results, session  # noqa: E402
from sil_plant.loop.control_channel import DEFAULT_CONTROL_PORT, Command, Control, Hello  # noqa: E402
from sil_plant.loop.external_plant import ExternalPlant, PlantLostError  # noqa: E402

EXIT_FAILED, EXIT_WRONG_USE, EXIT_INTERRUPTED = 1, 2, 130
WARM_UP_FAULT = Fault("delayed", "motion", 0.0, 0.001, 1.0)  # compiles the plant that faults may come to


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line; a wrong one ends the program with status 2."""
    parser = CommandLine(prog="run.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--load", type=float, metavar="KG", help="load at the tip; default: the scenario's")
    parser.add_argument("--bus", default="vcan0", metavar="BUS", help="vcan0 (default), can0, tcp:HOST:PORT, inproc")
    parser.add_argument(
        "--ecu", choices=("external", "spawn"), default="external", help="use an ECU that runs, or start one"
    )
    parser.add_argument("--pace", choices=("realtime", "strict", "lockstep"), help="of a spawned ECU; default realtime")
    parser.add_argument("--duration", type=float, metavar="S", help="of the motion; default: the scenario's, 10")
    parser.add_argument("--seed", type=int, metavar="N", help="of the sensor noise; default: the scenario's, 1")
    parser.add_argument("--controller", choices=session.CONTROLLERS, default="diarc")
    parser.add_argument("--params", type=Path, metavar="FILE", help="commissioned set from tools/commission.py")
    parser.add_argument("--arm", type=Path, default=REFERENCE_ARM, metavar="FILE", help="machine file")
    parser.add_argument(
        "--profile", choices=PROFILE_NAMES, default="paper", help="how kind the plant is; default paper"
    )
    parser.add_argument("--scenario", type=Path, default=DEFAULT_SCENARIO, metavar="FILE")
    parser.add_argument("--fmu", type=Path, metavar="FILE", help="another plant: a co-simulation FMU; goes with --map")
    parser.add_argument("--map", type=Path, metavar="FILE", help="which of the FMU's variables is what: docs/fmu.md")
    parser.add_argument("--scalar", choices=inproc.SCALARS, default="double", help="number type of the law, in process")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the trace, one row per tick")
    parser.add_argument("--quiet", action="store_true", help="no progress bar and no table")
    parser.add_argument(
        "--control",
        type=int,
        nargs="?",
        const=DEFAULT_CONTROL_PORT,
        metavar="PORT",
        help=f"let programs on this computer change load and faults while it runs; default {DEFAULT_CONTROL_PORT}",
    )
    parser.add_argument("--endless", action="store_true", help="after the scenario's end go on, at rest, until Ctrl-C")
    arguments = parser.parse_args(argv)
    if arguments.pace and arguments.ecu != "spawn":
        parser.error("--pace is the spawned ECU's: it goes with --ecu spawn")
    if (arguments.fmu is None) != (arguments.map is None):
        parser.error("--fmu and --map go together: docs/fmu.md describes the map")
    if arguments.bus.strip() == "inproc" and (arguments.control is not None or arguments.endless):
        parser.error("--control and --endless are for a bus: --bus vcan0 or --bus tcp:127.0.0.1:29536")
    if arguments.endless and (arguments.json or arguments.csv):
        parser.error("--endless has no figures to write: leave --json and --csv out, or let it end: --duration")
    if arguments.control is not None and not 0 <= arguments.control <= 65535:
        parser.error(f"--control {arguments.control}: a port is 0 to 65535")
    if arguments.fmu is not None and (arguments.control is not None or arguments.endless):
        parser.error("--control and --endless are for our own plant: leave --fmu out")
    return arguments


class Inputs(NamedTuple):
    """Everything a run needs, checked."""

    machine: Machine  # what the ECU believes
    plant_machine: Machine  # what the plant is
    scenario: Scenario
    tare: bool
    address: BusAddress
    plant: ExternalPlant | None


def load_inputs(arguments: argparse.Namespace) -> Inputs:
    """Read and check everything a run needs."""
    address = parse_bus(arguments.bus)
    if address.kind == "inproc" and arguments.ecu == "spawn":
        raise ConfigError("--ecu spawn needs a bus: --bus vcan0 or --bus tcp:127.0.0.1:29536")
    if address.kind != "inproc" and arguments.scalar != "double":
        raise ConfigError("--scalar is for --bus inproc; an ECU on a bus has the number type it was built with")
    if arguments.arm != REFERENCE_ARM and address.kind != "inproc" and arguments.ecu != "spawn":
        say("run.py: note: the ECU on the bus must have been started with this machine's --params")
    profile = load_profile(arguments.profile)
    machine = load_machine(arguments.arm)
    if arguments.params:
        machine = load_commissioned(arguments.params, machine)
    machine = with_changes(machine, profile.machine, f"profile {profile.name}: [machine]")
    scenario = load_scenario(arguments.scenario)
    if arguments.load is not None:
        if not arguments.load >= 0.0:
            raise ConfigError(f"--load {arguments.load:g}: a load is 0 kg or more")
        scenario = with_load(scenario, arguments.load)
    if arguments.duration is not None:
        if not 0.01 <= arguments.duration <= LONGEST_RUN_S:
            raise ConfigError(f"--duration {arguments.duration:g}: 0.01 to {LONGEST_RUN_S:g} s is possible")
        scenario = replace(scenario, duration_s=arguments.duration)
    if arguments.seed is not None:
        if not 0 <= arguments.seed < 2**63:
            raise ConfigError(f"--seed {arguments.seed}: a whole number from 0 to 2^63 - 1 is needed")
        scenario = replace(scenario, seed=arguments.seed)
    check_scenario(scenario, machine)
    execution.check_faults(scenario.faults, address.kind == "inproc", arguments.ecu == "spawn")
    plant_machine = with_changes(machine, profile.effects, f"profile {profile.name}: [effects]")
    plant_machine = with_changes(plant_machine, scenario.plant, f"{arguments.scenario}: [plant]")
    for path in (arguments.json, arguments.csv):
        if path is not None:
            results.check_writable(path)
    plant = None
    if arguments.fmu is not None:
        if scenario.faults:
            raise ConfigError("--fmu: the faults of a scenario are for our own plant; choose a scenario without any")
        plant = ExternalPlant(arguments.fmu, arguments.map)
        for note in plant.notes(scenario, profile.name == "paper"):
            if not arguments.quiet:
                say(f"run.py: note: {note}")
    return Inputs(machine, plant_machine, scenario, profile.tare, address, plant)


def write_outputs(
    arguments: argparse.Namespace,
    record: session.Record,
    run: results.Run,
    faults: list[str],
    commands: list[Command] | None,
) -> bool:
    """Print the table and write what was recorded; one file that fails does not cost the others."""
    faults = faults + results.command_lines(commands or [])
    result = results.summarise(record, run)
    if not arguments.quiet:
        show("\n".join([results.table(result, protocol.worst_case_bus_load()), *faults]))
    written = True
    for path, write in (
        (arguments.json, lambda path: results.write_json(path, result, commands)),
        (arguments.csv, lambda path: results.write_csv(path, record, run)),
    ):
        try:
            if path is not None:
                write(path)
        except ConfigError as error:
            say(f"run.py: {error}")
            written = False
    return written


def open_control(arguments: argparse.Namespace, machine: Machine) -> Control | None:
    """Listen for those who want to act on the plant, where that is asked for."""
    if arguments.control is None:
        return None
    heaviest_kg = machine["estimator.prior.m_t_kg.high"]
    hello = Hello(arguments.bus.strip(), str(arguments.arm.resolve()), heaviest_kg, arguments.ecu == "spawn")
    control = Control(arguments.control, hello)
    if not arguments.quiet:
        say(f"run.py: the plant takes commands on 127.0.0.1:{control.port}; python tools/live.py {arguments.bus}")
    return control


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    arguments = parse_arguments(argv)
    signal.signal(signal.SIGTERM, _interrupt)
    with ExitStack() as cleanup:
        return carry_out(arguments, cleanup)


def carry_out(arguments: argparse.Namespace, cleanup: ExitStack) -> int:
    """Run what the command line asks for; what must be undone at the end goes to ``cleanup``."""
    try:
        inputs = load_inputs(arguments)
        machine, scenario = inputs.machine, inputs.scenario
        execution.compile_plant(machine, scenario)
        if arguments.control is not None and not scenario.faults:
            execution.compile_plant(machine, replace(scenario, faults=(WARM_UP_FAULT,)))
        period_s = execution.PERIOD_US * 1e-6
        try:
            run = session.make_session(
                inputs.plant_machine, scenario, arguments.controller, scenario.seed, period_s, inputs.tare
            )
        except ValueError as error:
            raise ConfigError(f"{error} with the supply of {machine.name}") from error
        image = parameter_image(machine)
        control = open_control(arguments, machine)
        if inputs.plant is not None:
            cleanup.callback(inputs.plant.close)
            inputs.plant.start(run, scenario)
    except (ConfigError, BusError) as error:
        for line in str(error).splitlines():
            say(f"run.py: {line}")
        return EXIT_WRONG_USE
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED

    status, problem = 0, None
    start, wall_s = time.perf_counter(), None
    console = Console(stderr=True)
    show = console.is_terminal and not arguments.quiet and not arguments.endless
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"),
        TimeRemainingColumn(), console=console, transient=True, disable=not show,
    )  # fmt: skip
    with bar:
        task = bar.add_task("arm moving", total=len(run.noise))
        progress: Callable[[int], None] = (lambda tick: bar.update(task, completed=tick)) if show else (lambda _: None)
        try:
            if inputs.address.kind == "inproc":
                wall_s = execution.in_process(run, image, arguments.scalar, progress, inputs.plant)
            else:
                pace = (arguments.pace or "realtime") if arguments.ecu == "spawn" else None
                wall_s = execution.over_bus(
                    run,
                    inputs.address,
                    pace,
                    image,
                    progress,
                    arguments.quiet,
                    plant=inputs.plant,
                    commands=control,
                    endless=arguments.endless,
                )
        except (ConfigError, BusError, bus_run.EcuMissingError) as error:
            status, problem = EXIT_WRONG_USE, str(error)
        except (bus_run.EcuLostError, PlantLostError) as error:
            status, problem = EXIT_FAILED, str(error)
        except KeyboardInterrupt:
            bus_run.close_valves(run, inputs.plant)
            status, problem = (
                EXIT_INTERRUPTED,
                "interrupted; the valves are closed, what was recorded is kept",
            )

    if control is not None:
        control.close()
        run = control.session or run
    if status == 0:
        problem = execution.outcome(run)
        status = EXIT_FAILED if problem else 0
    if run.progress.index[session.TICK] and not arguments.endless:
        figures = results.run_of(
            run,
            arguments.controller,
            machine.name if inputs.plant is None else f"{machine.name}, plant {inputs.plant.path.name}",
            scenario.name,
            scenario.seed,
            arguments.bus,
            time.perf_counter() - start if wall_s is None else wall_s,
        )
        commands = None if control is None else control.commands
        faults = results.fault_lines(run, scenario.faults)
        if not write_outputs(arguments, run.record, figures, faults, commands):
            status = status or EXIT_WRONG_USE
    if problem:
        say(f"run.py: {problem}")
    late = int(run.monitor.whole[session.LATE])
    if late and not arguments.quiet and not run.errors.frame_loss and not run.faulty:
        say(
            f"run.py: note: {late} ticks ended without all sensor frames, because this machine paused the plant for "
            "longer than the ECU waits; the trace differs from an undisturbed run's"
        )
    return status


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Treat SIGTERM as Ctrl-C: the run ends in order."""
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
