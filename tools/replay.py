"""Replay a recording: feed the ECU in this process what it heard, and compare what it says, bit for bit.

A field log is a regression test this way. The recording has to hold a start of the ECU (its boot-up message, after
power-on or NMT reset), and the ECU here needs the parameters and the number type of the one recorded.

Examples
--------
  python tools/record.py vcan0 run.blf &  ./firmware/diarc_ecu vcan0 &  python sil_plant/run.py --load 2.5
  python tools/replay.py run.blf
  python tools/replay.py run.blf --params out/reference.commissioned.params
  python tools/replay.py field.log --arm sil_plant/arms/loader.toml --scalar float

Exit status: 0 identical, 1 different, 2 the recording (or the command line) cannot be used, or only in part.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import suppress
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__, mf4=True)

from rich.console import Console  # noqa: E402
from rich.progress import BarColumn, Progress, TextColumn  # noqa: E402

from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.experiments.commissioning import load_commissioned  # noqa: E402
from sil_plant.inputs.machine import REFERENCE_ARM, load_machine, parameter_image, with_changes  # noqa: E402
from sil_plant.inputs.scenario import PROFILE_NAMES, load_profile  # noqa: E402
from sil_plant.loop.inproc import SCALARS  # noqa: E402
from sil_plant.recordings.recording import Recording, read_recording  # noqa: E402
from sil_plant.recordings.replay import Replay, load_ecu_image, replay  # noqa: E402

EXIT_DIFFERENT, EXIT_UNUSABLE, EXIT_INTERRUPTED = 1, 2, 130


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line; a wrong one ends the program with status 2."""
    parser = CommandLine(prog="replay.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, metavar="RECORDING", help=".blf, .asc, .log, .mf4 or .csv")
    parser.add_argument(
        "--params", type=Path, metavar="FILE", help="what the ECU was started with: a .params image, or a set in .toml"
    )
    parser.add_argument("--arm", type=Path, metavar="MACHINE.toml", help="machine file; default: the reference arm")
    parser.add_argument("--profile", choices=PROFILE_NAMES, help="of the run, where run.py started the ECU with one")
    parser.add_argument("--scalar", choices=SCALARS, default="double", help="number type of the ECU; default double")
    parser.add_argument("--quiet", action="store_true", help="no progress bar, and nothing when identical")
    arguments = parser.parse_args(argv)
    if arguments.params and arguments.params.suffix != ".toml" and (arguments.arm or arguments.profile):
        parser.error("--params with an image says everything about the machine: leave --arm and --profile out")
    return arguments


def load_image(arguments: argparse.Namespace) -> bytes | None:
    """The parameters that the ECU had; None for those built in.

    Raises
    ------
    ConfigError
        Naming the file, and what is wrong with it.
    """
    params, arm, profile = arguments.params, arguments.arm, arguments.profile
    if params is not None and params.suffix != ".toml":
        try:
            data = params.read_bytes()
        except OSError as error:
            raise ConfigError(f"{params}: cannot be read: {error.strerror}; check the path") from error
        return load_ecu_image(data, str(params))
    if params is None and arm is None and profile is None:
        return None
    machine = load_machine(arm or REFERENCE_ARM)
    if params is not None:
        machine = load_commissioned(params, machine)
    if profile is not None:
        chosen = load_profile(profile)
        machine = with_changes(machine, chosen.machine, f"profile {chosen.name}: [machine]")
    return parameter_image(machine)


def report(recording: Recording, result: Replay, scalar: str) -> str:
    """The result for people."""
    lines = [
        f"{recording.path}: {len(recording.rows)} frames, {recording.duration_s:.3f} s"
        + (f"; {recording.ignored} others (29-bit, remote, error, FD) left out" if recording.ignored else "")
    ]
    for section in result.sections:
        how = "NMT reset" if section.by_reset else "start of the ECU"
        end = f", then {section.ends_at_gap} ticks are missing" if section.ends_at_gap else ""
        lines.append(f"  section {section.number}: {how} at {section.time_s:.3f} s, {section.ticks} ticks{end}")
    lines += [f"  note: {note}" for note in result.notes]
    width = max([len(name) for name in result.counts], default=0)
    lines.append(f"  {'':{width}}  compared  different  not recorded  not replayed")
    for name, count in sorted(result.counts.items()):
        lines.append(
            f"  {name:{width}}  {count.compared:8}  {count.different:9}  {count.not_recorded:12}  "
            f"{count.not_replayed:12}"
        )
    if result.first is not None:
        first = result.first
        lines += [
            f"  first difference: section {first.section}, tick {first.tick} ({first.time_s:.3f} s): {first.frame} "
            f"{first.signal}",
            f"    recorded {first.recorded}",
            f"    replayed {first.replayed}",
            "  If nothing was meant to change: had the ECU these parameters (--params, --arm, --profile) and this "
            f"number type (--scalar, here {scalar})?",
        ]
    return "\n".join(lines)


def other_number_type(recording: Recording, image: bytes | None, scalar: str) -> str:
    """Whether the ECU recorded had another number type than the one replayed."""
    for other in SCALARS:
        with suppress(ConfigError):
            if other != scalar and replay(recording, image, other).is_identical:
                return f"; identical with --scalar {other}"
    return ""


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    arguments = parse_arguments(argv)
    console = Console(stderr=True)
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"), console=console,
        transient=True, disable=arguments.quiet or not console.is_terminal,
    )  # fmt: skip
    try:
        with bar:
            task = bar.add_task("reading", total=1.0)
            recording = read_recording(arguments.recording)
            image = load_image(arguments)
            bar.update(task, description="replaying")
            result = replay(recording, image, arguments.scalar, lambda share: bar.update(task, completed=share))
    except ConfigError as error:
        say(f"replay.py: {error}")
        return EXIT_UNUSABLE
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    unusable = result.unusable
    if recording.damage:
        unusable = unusable or (
            f"the file is damaged: {recording.damage}; readable up to {recording.duration_s:.3f} s "
            f"({len(recording.rows)} frames)"
        )
    if not arguments.quiet or unusable or not result.is_identical:
        show(report(recording, result, arguments.scalar))
    if unusable:
        say(f"replay.py: {arguments.recording}: {unusable}")
        say(f"replay.py: up to there: {'identical' if result.is_identical else 'different'}")
        return EXIT_UNUSABLE
    if not result.is_identical:
        say("replay.py: different" + other_number_type(recording, image, arguments.scalar))
        return EXIT_DIFFERENT
    if not arguments.quiet:
        show("identical")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
