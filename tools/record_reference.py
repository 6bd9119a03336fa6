"""Make the recording that the tests replay, tests/sil/data/reference.log.gz, anew.

It has to be made again whenever the ECU is meant to say something else than before: after a change of the law, the
estimator, the frames or the reference arm. Look at what changed first: python tools/replay.py
tests/sil/data/reference.log.gz --scalar fixed. The run is in this process and in simulated time, in fixed point, so
that every compiler and every computer makes the same bytes.

Examples
--------
  python tools/record_reference.py
"""

from __future__ import annotations

import argparse
import gzip
import io
import sys
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__, mf4=True)

import can  # noqa: E402
import numpy as np  # noqa: E402

from sil_plant.bus.frames import FRAME_BYTES  # noqa: E402
from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.inputs.machine import REFERENCE_ARM, load_machine  # noqa: E402
from sil_plant.inputs.scenario import DEFAULT_SCENARIO, load_scenario, with_load  # noqa: E402
from sil_plant.loop.execution import PERIOD_US  # noqa: E402
from sil_plant.loop.inproc import InprocEcu  # noqa: E402
from sil_plant.loop.session import NMT_RESET, make_session, nmt_frame  # noqa: E402
from sil_plant.recordings.capture import capture  # noqa: E402

REFERENCE = ROOT / "tests" / "sil" / "data" / "reference.log.gz"
SCALAR = "fixed"
LOAD_KG = 2.5
DURATION_S = 1.2
SEED = 1
LOST_TICK = 700  # an encoder frame does not come: the ECU predicts its angle
RESET_TICK = 1150  # NMT reset: a second section


def disturb(tick: int, heard: np.ndarray) -> np.ndarray:
    """What the bus does to the frames for the ECU."""
    if tick == LOST_TICK:
        return heard[1:]
    if tick == RESET_TICK:
        return np.concatenate((nmt_frame(NMT_RESET).reshape(1, FRAME_BYTES), heard))
    return heard


def reference_log() -> bytes:
    """The recording, gzipped.

    Raises
    ------
    ConfigError
        When the firmware is not built.
    """
    scenario = replace(with_load(load_scenario(DEFAULT_SCENARIO), LOAD_KG), duration_s=DURATION_S)
    run = make_session(load_machine(REFERENCE_ARM), scenario, "diarc", SEED, PERIOD_US * 1e-6)
    text = io.StringIO()
    writer = can.CanutilsLogWriter(text)
    for message in capture(run, InprocEcu(None, PERIOD_US, SCALAR), disturb):
        writer.on_message_received(message)
    return gzip.compress(text.getvalue().encode("ascii"), mtime=0)


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    parser = CommandLine(
        prog="record_reference.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.parse_args(argv)
    try:
        data = reference_log()
        REFERENCE.parent.mkdir(exist_ok=True)
        REFERENCE.write_bytes(data)
    except (ConfigError, OSError) as error:
        say(f"record_reference.py: {error}")
        return 2
    show(f"written: {REFERENCE.relative_to(ROOT)}, {len(data)} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
