"""An image for a Cortex-M, built and started in QEMU, with its UART on a TCP socket."""

from __future__ import annotations

import re
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

ROOT = Path(__file__).resolve().parents[2]
BUILD_LIMIT_S = 100.0
ANSWER_LIMIT_S = 5.0
STOP_LIMIT_S = 5.0
CYCLE_NS = 40  # SysTick and processor: 25 MHz
INSTRUCTION_NS = 64  # -icount shift=6: 2^6 ns of emulated time for each
# enum stage in firmware/ports/cortex_m/measure.h
STAGES = ("wait", "uart", "receive", "frames", "estimate", "control", "send", "tick")


@dataclass(frozen=True)
class Image:
    """One of the presets: which processor, and which number type of the law."""

    preset: str
    machine: str
    scalar: str


IMAGES = (
    Image("cortex-m4f", "mps2-an386", "float"),
    Image("cortex-m3", "mps2-an385", "fixed"),
)


class BoardError(Exception):
    """Something is missing or does not answer; says what to do."""


def build(image: Image, folder: str = "", options: Sequence[str] = ()) -> Path:
    """Build an image, or bring it up to date.

    Parameters
    ----------
    image : Image
        Which one.
    folder : str
        Below ``build/``; default: the preset's own.
    options : sequence of str
        More arguments for cmake.

    Returns
    -------
    Path
        The ELF file.
    """
    for program, package in (("arm-none-eabi-gcc", "gcc-arm-none-eabi"), ("cmake", "cmake")):
        if shutil.which(program) is None:
            raise BoardError(f"{program} is not installed: sudo apt-get install {package}")
    target = ROOT / "build" / (folder or image.preset)
    configure = ["cmake", "--preset", image.preset, "-B", str(target), *options]
    for command in (configure, ["cmake", "--build", str(target), "--parallel", "2"]):
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=BUILD_LIMIT_S, check=False)
        if done.returncode != 0:
            raise BoardError(f"{' '.join(command)} failed:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
    return target / "diarc_ecu.elf"


class EmulatedBoard:
    """A board that runs an image until the block is left; it starts when somebody connects.

    Parameters
    ----------
    image : Image
        Which processor.
    elf : Path
        What it runs.
    counting : bool
        Let each instruction take the same emulated time, so that cycles count instructions.

    Attributes
    ----------
    bus : str
        Its bus string.
    """

    def __init__(self, image: Image, elf: Path, counting: bool = False) -> None:
        qemu = shutil.which("qemu-system-arm")
        if qemu is None:
            raise BoardError("qemu-system-arm is not installed: sudo apt-get install qemu-system-arm")
        self._log = tempfile.TemporaryFile()
        with socket.create_server(("127.0.0.1", 0)) as listener:  # handed over, so the port is ours from the start
            self.port = int(listener.getsockname()[1])
            self.bus = f"slcan:socket://127.0.0.1:{self.port}"
            command = [qemu, "-M", image.machine, "-kernel", str(elf), "-display", "none", "-monitor", "none"]
            command += ["-chardev", f"socket,id=uart,fd={listener.fileno()},server=on,wait=on,nodelay=on"]
            command += ["-serial", "chardev:uart", "-no-reboot"]
            command += ["-icount", "shift=6"] if counting else []
            self.process = subprocess.Popen(
                command,
                pass_fds=[listener.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=self._log,
            )

    def __enter__(self) -> EmulatedBoard:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        self.process.terminate()
        try:
            self.process.wait(STOP_LIMIT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._log.close()

    def check(self) -> None:
        """Raise when the emulator has ended."""
        if self.process.poll() is not None:
            self._log.seek(0)
            text = self._log.read().decode(errors="replace")
            raise BoardError(f"the emulator ended with status {self.process.returncode}: {text}")

    def connect(self) -> Wire:
        """Connect to the UART."""
        self.check()
        return Wire(self.port)

    def figures(self) -> Figures:
        """Ask an image that counts (DIARC_COUNT_INSTRUCTIONS) for what it has counted."""
        with self.connect() as wire:
            text = wire.ask("C\rM\r", r"MFF[0-9A-F]{16}0{8}\r")
        lines = re.findall(r"M0([0-9])([0-9A-F]{8})([0-9A-F]{8})([0-9A-F]{8})\r", text)
        last = re.search(r"MFF([0-9A-F]{8})([0-9A-F]{8})", text)
        if len(lines) != len(STAGES) or last is None:
            raise BoardError(f"the image does not count: {text[-200:]!r}")
        instructions = {
            STAGES[int(stage)]: tuple(round(int(value, 16) * CYCLE_NS / INSTRUCTION_NS) for value in values)
            for stage, *values in lines
        }
        return Figures(int(last[1], 16), int(last[2], 16), instructions)


@dataclass(frozen=True)
class Figures:
    """What an image has counted."""

    ticks: int
    stack_bytes: int
    instructions: dict[str, tuple[int, ...]]  # least, mean and most of a tick, by stage


class Wire:
    """The UART's far end, character by character, with bounded waits."""

    def __init__(self, port: int) -> None:
        self._sock = socket.create_connection(("127.0.0.1", port), timeout=ANSWER_LIMIT_S)
        self.text = ""

    def __enter__(self) -> Wire:
        return self

    def __exit__(self, *exc: object) -> None:
        self._sock.close()

    def write(self, text: str) -> None:
        """Send characters."""
        self._sock.sendall(text.encode())

    def read_until(self, pattern: str, limit_s: float = ANSWER_LIMIT_S) -> str:
        """Read until the pattern is found in what came since the last call; all of that, up to the match's end."""
        end = time.monotonic() + limit_s
        while (found := re.search(pattern, self.text)) is None:
            self._sock.settimeout(max(0.001, end - time.monotonic()))
            try:
                chunk = self._sock.recv(1 << 16)
            except TimeoutError as error:
                raise BoardError(f"no {pattern!r} within {limit_s:g} s, but {self.text[-200:]!r}") from error
            if not chunk:
                raise BoardError(f"the emulator closed the connection after {self.text[-200:]!r}")
            self.text += chunk.decode("latin-1")
        before, self.text = self.text[: found.end()], self.text[found.end() :]
        return before

    def ask(self, text: str, pattern: str) -> str:
        """Send characters, then read until the pattern."""
        self.write(text)
        return self.read_until(pattern)
