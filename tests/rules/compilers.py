"""Every source of the firmware, with the compiler's arguments as CMake has them."""

from __future__ import annotations

import json
import os
import platform
import shlex
import shutil
import subprocess
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCALARS = ("double", "float", "fixed")
CORE = ("firmware/control/", "firmware/ecu/")
LIMIT_S = 60.0  # for one compiler run, which takes a fraction of a second
PACKAGES = {
    "gcc": "gcc",
    "clang": "clang",
    "arm-none-eabi-gcc": "gcc-arm-none-eabi",
    "cmake": "cmake",
    "nm": "binutils",
}


@dataclass(frozen=True)
class Unit:
    """One source file for one number type, as it is compiled."""

    source: str  # from the repository's root
    scalar: str
    compiler: str
    flags: tuple[str, ...]  # without compiler, output and source


@dataclass(frozen=True)
class Outcome:
    """What a compiler made of a unit."""

    unit: Unit
    object: Path
    passed: bool
    said: str


def need(*commands: str) -> None:
    """Fail, naming the Debian package, when a command is missing."""
    for command in commands:
        if shutil.which(command) is None:
            pytest.fail(f"{command} is missing: sudo apt-get install {PACKAGES[command]}", pytrace=False)


def is_pc() -> bool:
    """True on a machine whose compiler also makes 32-bit programs."""
    return platform.machine() in ("x86_64", "AMD64")


def need_32_bit() -> None:
    """Fail, naming the Debian package, when gcc has no 32-bit headers."""
    if not is_pc():
        pytest.skip("-m32 is for x86-64")
    probe = ["gcc", "-m32", "-E", "-x", "c", "-"]
    if subprocess.run(probe, input="#include <stdio.h>\n", text=True, capture_output=True, timeout=LIMIT_S).returncode:
        pytest.fail("gcc -m32 has no headers: sudo apt-get install gcc-multilib", pytrace=False)


def sources(*patterns: str, root: Path = ROOT) -> list[str]:
    """Files that match, as paths from `root`."""
    found = sorted(str(path.relative_to(root)) for pattern in patterns for path in root.glob(pattern))
    assert found, f"nothing matches {patterns}"
    return found


def copy_firmware(root: Path) -> Path:
    """The firmware's sources in a folder of their own, to be spoiled there."""
    ignore = shutil.ignore_patterns("diarc_ecu")
    shutil.copytree(ROOT / "firmware", root / "firmware", ignore=ignore)
    shutil.copytree(ROOT / "can_protocol" / "generated", root / "can_protocol" / "generated")
    return root


def append(root: Path, source: str, text: str) -> None:
    """Add C at the end of a copy's file."""
    assert root != ROOT
    with (root / source).open("a", encoding="utf-8") as file:
        file.write(f"\n{text}\n")


def run_compilers(
    units: Iterable[Unit],
    folder: Path,
    extra: Sequence[str] = (),
    *,
    compiler: str | None = None,
    root: Path = ROOT,
    drop: Sequence[str] = (),
) -> list[Outcome]:
    """Compile each unit with its own flags and `extra`, less those in `drop`, into `folder`."""

    def one(unit: Unit) -> Outcome:
        target = folder / f"{unit.source.replace('/', '_')}.{unit.scalar}.o"
        flags = [flag.replace(str(ROOT), str(root)) for flag in unit.flags if flag not in drop]
        command = [compiler or unit.compiler, *flags, *extra, "-c", unit.source, "-o", str(target)]
        result = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=LIMIT_S)
        return Outcome(unit, target, result.returncode == 0, (result.stdout + result.stderr).strip())

    folder.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        return list(pool.map(one, units))


def complaints(outcomes: Iterable[Outcome]) -> list[str]:
    """What compilers said, warning or error."""
    return [f"{o.unit.source} ({o.unit.scalar}): {o.said or 'failed'}" for o in outcomes if o.said or not o.passed]


def units_in(folder: Path) -> list[Unit]:
    """What is compiled in a folder that CMake configured."""
    units = []
    for entry in json.loads((folder / "compile_commands.json").read_text("utf-8")):
        source = str(Path(entry["file"]).relative_to(ROOT))
        arguments = shlex.split(entry["command"])
        output = arguments.index("-o")
        flags = [*arguments[1:output], *arguments[output + 2 :]]
        flags = [flag for flag in flags if flag not in ("-c", entry["file"])]
        scalar = next((s for s in SCALARS if f"-DDIARC_SCALAR_{s.upper()}=1" in flags), "none")
        units.append(Unit(source, scalar, arguments[0], tuple(flags)))
    return units
