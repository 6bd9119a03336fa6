"""Write the simulated arm as a co-simulation FMU that any tool loads: no Python is needed when it runs.

Example: .venv/bin/python tools/export_fmu.py plant -o plant.fmu
         .venv/bin/python tools/export_fmu.py plant --arm my_arm.toml --load 2.5 --fmi 3.0 -o plant.fmu

The ECU's FMU is build/diarc_ecu.fmu, by `make fmu`; CMake calls the other commands for it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say  # noqa: E402

enter(__file__)

from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.fmu import ecu_fmu, plant_fmu  # noqa: E402
from sil_plant.inputs.machine import REFERENCE_ARM, load_machine, parameter_image, with_changes  # noqa: E402
from sil_plant.inputs.scenario import PROFILE_NAMES, load_profile  # noqa: E402
from sil_plant.loop import results  # noqa: E402


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    parser = CommandLine(
        prog="export_fmu.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    plant = commands.add_parser("plant", help="the simulated arm")
    plant.add_argument("-o", "--output", type=Path, required=True, metavar="FILE")
    plant.add_argument("--arm", type=Path, default=REFERENCE_ARM, metavar="FILE", help="machine file")
    plant.add_argument("--profile", choices=PROFILE_NAMES, default="paper", help="how kind the plant is")
    plant.add_argument("--load", type=float, default=0.0, metavar="KG", help="load at the tip; default 0")
    plant.add_argument(
        "--pose", type=float, nargs=2, default=(0.0, 0.0), metavar="RAD", help="start angles; default 0 0"
    )
    plant.add_argument("--fmi", choices=plant_fmu.VERSIONS, default="2.0", help="version; default 2.0")
    header = commands.add_parser("ecu-header", help="the ECU's variables for its C code")
    header.add_argument("-o", "--output", type=Path, required=True, metavar="FILE")
    image = commands.add_parser("image", help="the parameter image of a machine file, for the ECU's FMU")
    image.add_argument("-o", "--output", type=Path, required=True, metavar="FILE")
    image.add_argument("--arm", type=Path, default=REFERENCE_ARM, metavar="FILE", help="machine file")
    pack = commands.add_parser("ecu", help="the ECU, from its built library")
    pack.add_argument("--library", type=Path, required=True, metavar="FILE")
    pack.add_argument("-o", "--output", type=Path, required=True, metavar="FILE")
    arguments = parser.parse_args(argv)
    try:
        if arguments.command == "ecu-header":
            arguments.output.write_text(ecu_fmu.variables_header(), encoding="utf-8")
            return 0
        if arguments.command == "ecu":
            ecu_fmu.pack(arguments.library, arguments.output)
            return 0
        if arguments.command == "image":
            results.check_writable(arguments.output)
            arguments.output.write_bytes(parameter_image(load_machine(arguments.arm)))
            return 0
        machine = load_machine(arguments.arm)
        profile = load_profile(arguments.profile)
        machine = with_changes(machine, profile.machine, f"profile {profile.name}: [machine]")
        machine = with_changes(machine, profile.effects, f"profile {profile.name}: [effects]")
        if not 0.0 <= arguments.load < float("inf"):
            raise ConfigError(f"--load {arguments.load:g}: a load is 0 kg or more")
        for joint, angle in zip(("swing", "wrist"), arguments.pose, strict=True):
            low, high = machine[f"{joint}.q_min_rad"], machine[f"{joint}.q_max_rad"]
            if not low <= angle <= high:
                raise ConfigError(f"--pose: {joint} {angle:g} is outside {low:g} to {high:g}")
        results.check_writable(arguments.output)
        pose = (arguments.pose[0], arguments.pose[1])
        plant_fmu.export_plant(machine, arguments.output, arguments.load, pose, arguments.fmi)
    except ConfigError as error:
        say(f"export_fmu.py: {error}")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
