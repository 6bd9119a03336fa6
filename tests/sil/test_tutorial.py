"""docs/tutorial.md, to the end, as its reader does it: its files written, its commands run, its figures compared.

The text has marks that its reader does not see:

    <!-- file NAME -->     before a TOML block: write it
    <!-- exit N -->        before a console block: its last command ends so; without it, all end with 0
    <!-- bus -->           the block is for a bus: here a hub in the place of vcan0
    <!-- needs FILE -->    left out if there is no such file

In a console block, what follows a command is lines of its output, in order. Others may be between; "..." stands for
anything; numbers are as printed within 15 %, or 2 in the last place.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from sil_plant.bus.hub import Hub
from tests.sil.bounded import run_bounded

ROOT = Path(__file__).resolve().parents[2]
TUTORIAL = ROOT / "docs" / "tutorial.md"
LIMIT_S = 120.0
TOLERANCE = 0.15
NUMBER = re.compile(r"(?<![A-Za-z_])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
FENCE = re.compile(r"^```(\w*)\s*$")
MARK = re.compile(r"^<!-- (file|exit|bus|needs) ?(.*?) ?-->$")


@dataclass
class Command:
    """One command and the output the text claims."""

    text: str
    expected: list[str] = field(default_factory=list)


@dataclass
class Block:
    """One block of the text that is to be done."""

    line: int
    language: str
    body: list[str]
    marks: dict[str, str]

    def commands(self) -> list[Command]:
        """The commands of a shell or console block; a backslash continues a line."""
        found: list[Command] = []
        joined = "\n".join(self.body).replace("\\\n", " ").splitlines()
        for line in joined:
            if self.language == "sh":
                found.append(Command(line))
            elif line.startswith("$ "):
                found.append(Command(line[2:]))
            elif line.strip():
                found[-1].expected.append(line)
        return [command for command in found if command.text.strip()]


def read_blocks(text: str) -> list[Block]:
    """Every file and every block of commands, in order."""
    blocks: list[Block] = []
    marks: dict[str, str] = {}
    inside: Block | None = None
    for number, line in enumerate(text.splitlines(), start=1):
        fence, mark = FENCE.match(line), MARK.match(line)
        if inside is not None:
            if line == "```":
                blocks.append(inside)
                inside, marks = None, {}
            else:
                inside.body.append(line)
        elif fence:
            inside = Block(number, fence.group(1), [], marks)
        elif mark:
            marks[mark.group(1)] = mark.group(2)
        elif line.strip():
            marks = {}
    return [b for b in blocks if "file" in b.marks or b.language in ("sh", "console")]


def same(expected: str, line: str) -> bool:
    """Whether a line of output is what the text has: words the same, numbers near."""
    expected = " ".join(expected.split())
    line = " ".join(line.split())
    pattern, position, numbers = "", 0, []
    for match in NUMBER.finditer(expected):
        pattern += re.escape(expected[position : match.start()]) + "(" + NUMBER.pattern + ")"
        numbers.append(match.group())
        position = match.end()
    pattern += re.escape(expected[position:])
    pattern = pattern.replace(re.escape("..."), ".*")
    found = re.fullmatch(pattern, line)
    return found is not None and all(near(a, b) for a, b in zip(numbers, found.groups(), strict=True))


def near(printed: str, measured: str) -> bool:
    """Whether a number is the printed one within the tolerance."""
    mantissa, _, exponent = printed.partition("e")
    last_place = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    bound = max(TOLERANCE * abs(float(printed)), 2.0 * last_place)
    return abs(float(printed) - float(measured)) <= bound


@contextmanager
def bus() -> Iterator[str]:
    """A CAN bus without a kernel: a hub, served by a thread; its bus string."""
    stop = threading.Event()
    with Hub("127.0.0.1", 0) as hub:

        def serve() -> None:
            while not stop.is_set():
                hub.receive(0.02)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        try:
            yield f"tcp:127.0.0.1:{hub.port}"
        finally:
            stop.set()
            thread.join()


def run(script: str, folder: Path, environment: dict[str, str]) -> tuple[int, str]:
    """Run a script as the reader's shell does; its status and all that was printed. Nothing of it stays behind."""
    argv = ["bash", "-c", script]
    done = run_bounded(argv, LIMIT_S, cwd=folder, env=environment, stderr=subprocess.STDOUT)
    return done.returncode, done.stdout


def do(block: Block, folder: Path, environment: dict[str, str]) -> None:
    """Write a block's file, or run its commands and compare."""
    if "file" in block.marks:
        (folder / block.marks["file"]).write_text("\n".join(block.body) + "\n", encoding="utf-8")
        return
    if "bus" in block.marks:
        with bus() as name:
            script = "\n".join(command.text for command in block.commands()).replace("vcan0", name)
            status, out = run(script, folder, environment)
        compare(block, [line for c in block.commands() for line in c.expected], out)
        assert status == int(block.marks.get("exit", 0)), f"line {block.line}: status {status}\n{out}"
        return
    commands = block.commands()
    for command in commands:
        status, out = run(command.text, folder, environment)
        wanted = int(block.marks.get("exit", 0)) if command is commands[-1] else 0
        assert status == wanted, f"line {block.line}: {command.text}: status {status}, not {wanted}\n{out}"
        compare(block, command.expected, out)


def compare(block: Block, expected: list[str], out: str) -> None:
    """Every expected line is in the output, in order."""
    lines = iter(out.splitlines())
    for wanted in expected:
        if wanted.strip() != "...":
            assert any(same(wanted, line) for line in lines), f"line {block.line}: not printed: {wanted}\n{out}"


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder that looks like the project's, in which the reader's files do not get into the project."""
    for name in ("tools", "sil_plant", "firmware", "can_protocol", "docs"):
        (tmp_path / name).symlink_to(ROOT / name)
    launcher = tmp_path / "bin" / "python"  # a link to the interpreter would lose its environment
    launcher.parent.mkdir()
    launcher.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n', encoding="utf-8")
    launcher.chmod(0o755)
    return tmp_path


@pytest.mark.timeout(600)
def test_the_tutorial_leads_to_a_tracked_arm(checkout: Path) -> None:
    """GIVEN a checkout WHEN the tutorial is done from its first line to its last
    THEN every command ends as the text says and prints what the text shows.
    """
    environment = os.environ | {"PATH": f"{checkout / 'bin'}:{os.environ['PATH']}"}
    blocks = read_blocks(TUTORIAL.read_text(encoding="utf-8"))
    assert sum(len(b.commands()) for b in blocks if "file" not in b.marks) >= 12
    for block in blocks:
        if (ROOT / block.marks.get("needs", "docs")).exists():
            do(block, checkout, environment)


def test_a_wrong_figure_in_the_tutorial_is_noticed() -> None:
    """GIVEN lines as the text has them WHEN words or figures differ THEN they are not taken for the same."""
    assert same("load  true 60.000 kg  error +0.6650 kg", "load   true 60.000 kg  error +0.6616 kg")
    assert not same("load  true 60.000 kg  error +0.6650 kg", "load   true 60.000 kg  error +0.4616 kg")
    assert not same("load  true 60.000 kg", "weight true 60.000 kg")
    assert same("... 137% of the valve...", "saturated: needs 136% of the valve, with 60 kg")
    assert not same("... 137% of the valve...", "saturated: needs 110% of the valve, with 60 kg")
    assert near("0.03", "0.04") and not near("0.03", "0.06") and not near("12", "15")
