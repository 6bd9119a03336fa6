"""Parameters of an ECU on the bus: look, change, save, compare. Values are SI; names are those of machine files.

Examples
--------
  python tools/params.py list 'control.swing.*'
  python tools/params.py get wrist.q_max_rad
  python tools/params.py set control.swing.k1_1_s 60          in use at once, until power-off
  python tools/params.py save                                 .. and after it
  python tools/params.py load sil_plant/arms/loader.toml      a whole machine, or nothing of it
  python tools/params.py diff                                 what differs from the reference arm
  python tools/params.py restore                              the ECU's default, from its next start on
  python tools/params.py --bus tcp:127.0.0.1:29536 list       another bus than vcan0

What changes the machine is refused while the valves are driven. Exit: 0 done; 1 refused, or diff found
differences; 2 wrong use, no bus, or no ECU on it.
"""

from __future__ import annotations

import argparse
import fnmatch
import struct
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__)

from sil_plant.bus import ecu_parameters  # noqa: E402
from sil_plant.bus.ecu_parameters import EcuParameters, RefusedError  # noqa: E402
from sil_plant.bus.objects import parameter_unit  # noqa: E402
from sil_plant.bus.ports import BusError  # noqa: E402
from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.inputs.machine import REFERENCE_ARM, load_machine, load_parameter_table, parameter_image  # noqa: E402

EXIT_DIFFERENT = EXIT_REFUSED = 1
EXIT_WRONG_USE, EXIT_INTERRUPTED = 2, 130
UNTIL_POWER_OFF = "in use until power-off; to keep it: params.py save"


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line; a wrong one ends the program with status 2."""
    parser = CommandLine(prog="params.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bus", default="vcan0", metavar="BUS", help="vcan0 (default), can0, tcp:HOST:PORT, slcan:..")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=CommandLine)
    command = commands.add_parser("list", help="names, values, units and ranges")
    command.add_argument("pattern", nargs="?", default="*", help="part of the names, as a shell matches: 'wrist.*'")
    command = commands.add_parser("get", help="one value")
    command.add_argument("name")
    command = commands.add_parser("set", help="change one value, until power-off")
    command.add_argument("name")
    command.add_argument("value", help="SI")
    commands.add_parser("save", help="keep what is in use over power-off")
    command = commands.add_parser("load", help="put a whole machine file into use")
    command.add_argument("machine", type=Path, metavar="MACHINE.toml")
    commands.add_parser("restore", help="go back to the ECU's default, from its next start on")
    command = commands.add_parser("diff", help="what differs between the ECU and a machine file")
    command.add_argument("machine", type=Path, nargs="?", default=REFERENCE_ARM, metavar="MACHINE.toml")
    arguments, rest = parser.parse_known_args(_with_negative_value(argv))
    if rest:
        parser.error(f"{rest[0]} is not understood")
    return arguments


def _with_negative_value(argv: list[str]) -> list[str]:
    """``set NAME -1e-3`` is no option: argparse knows -1, but not every number."""
    if len(argv) >= 2 and argv[-1].startswith("-") and argv[-2] not in ("--bus", "--") and "set" in argv:
        try:
            float(argv[-1])
        except ValueError:
            return argv
        return [*argv[:-1], "--", argv[-1]]
    return argv


def number_text(value: float) -> str:
    """As many digits as binary32 has, no more than it needs."""
    for digits in range(6, 9):
        text = f"{value:.{digits}g}"
        if struct.pack("<f", float(text)) == struct.pack("<f", value):
            return text
    return f"{value:.9g}"


def table_text(rows: list[tuple[str, ...]]) -> str:
    """Columns, the first one and the last ones to the left, numbers to the right."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [
            cell.rjust(width) if k in (1, 2) else cell.ljust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def list_parameters(ecu: EcuParameters, pattern: str) -> int:
    """Print what matches the pattern; the exit status."""
    entries = [e for e in load_parameter_table().entries if fnmatch.fnmatchcase(e.name, pattern) or pattern in e.name]
    if not entries:
        raise RefusedError(f"{pattern}: no name matches; `params.py list` has all")
    values = ecu_parameters.image_values(ecu.image())
    rows = [("name", "value", "", "range", "")]
    rows += [
        (e.name, number_text(values[e.name]), parameter_unit(e), f"{e.low:g} to {e.high:g}", e.text) for e in entries
    ]
    show(table_text([(row[0], row[1], *row[2:]) for row in rows]))
    return 0


def get_parameter(ecu: EcuParameters, name: str) -> int:
    """Print one value with unit and range; the exit status."""
    _, entry = ecu_parameters.find_parameter(name)
    value, unit = number_text(ecu.get(name)), parameter_unit(entry)
    show(f"{name} = {value}{' ' if unit else ''}{unit}   ({entry.low:g} to {entry.high:g}; {entry.text})")
    return 0


def set_parameter(ecu: EcuParameters, name: str, text: str) -> int:
    """Change one value and read it back; the exit status."""
    _, entry = ecu_parameters.find_parameter(name)
    value = ecu_parameters.parse_value(entry, text)
    before = ecu.get(name)
    ecu.set(name, value)
    now = ecu.get(name)
    show(
        f"{name} = {number_text(now)} {parameter_unit(entry)}".rstrip()
        + f", was {number_text(before)}; {UNTIL_POWER_OFF}"
    )
    return 0


def differences(left: bytes, right: bytes) -> list[tuple[str, ...]]:
    """Rows of what differs between two images."""
    a, b = ecu_parameters.image_values(left), ecu_parameters.image_values(right)
    units = {entry.name: parameter_unit(entry) for entry in load_parameter_table().entries}
    return [(name, number_text(a[name]), number_text(b[name]), units.get(name, "")) for name in a if a[name] != b[name]]


def load_file(ecu: EcuParameters, path: Path) -> int:
    """Put a machine file into use; the exit status."""
    image = parameter_image(load_machine(path))
    changed = differences(ecu.image(), image)
    ecu.load(image)
    if ecu.image() != image:
        raise RefusedError(f"{path}: the ECU took it but has something else now; try again, look at the bus")
    show(f"{path}: {len(changed) or 'no'} value{'' if len(changed) == 1 else 's'} changed; {UNTIL_POWER_OFF}")
    return 0


def compare(ecu: EcuParameters, path: Path) -> int:
    """Print what differs; 0 when nothing does."""
    rows = differences(ecu.image(), parameter_image(load_machine(path)))
    if not rows:
        show(f"no difference between the ECU and {path}")
        return 0
    show(table_text([("name", "ECU", path.name, ""), *rows]))
    return EXIT_DIFFERENT


def run(arguments: argparse.Namespace) -> int:
    """Carry the command out; the exit status."""
    if arguments.command in ("get", "set"):  # a wrong name or number needs no bus to be found
        _, entry = ecu_parameters.find_parameter(arguments.name)
        if arguments.command == "set":
            ecu_parameters.parse_value(entry, arguments.value)
    if arguments.command in ("load", "diff"):
        load_machine(arguments.machine)
    with ecu_parameters.connect(arguments.bus) as ecu:
        if arguments.command == "list":
            return list_parameters(ecu, arguments.pattern)
        if arguments.command == "get":
            return get_parameter(ecu, arguments.name)
        if arguments.command == "set":
            return set_parameter(ecu, arguments.name, arguments.value)
        if arguments.command == "load":
            return load_file(ecu, arguments.machine)
        if arguments.command == "diff":
            return compare(ecu, arguments.machine)
        if arguments.command == "save":
            ecu.save()
            show("saved: what is in use now is used at the next start, too")
        else:
            ecu.restore()
            show("the ECU starts with its default next time; until then nothing changes")
    return 0


def main(argv: list[str]) -> int:
    """Run the program; its exit status."""
    arguments = parse_arguments(argv)
    try:
        return run(arguments)
    except RefusedError as error:
        say(f"params.py: {error}")
        return EXIT_REFUSED
    except (ConfigError, BusError) as error:
        say(f"params.py: {error}")
        return EXIT_WRONG_USE
    except KeyboardInterrupt:
        say("params.py: interrupted")
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
