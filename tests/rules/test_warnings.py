"""Compilers: what one of them, or one word size, would warn of unseen."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.rules.compilers import (
    CORE,
    ROOT,
    SCALARS,
    Unit,
    append,
    complaints,
    copy_firmware,
    need,
    need_32_bit,
    run_compilers,
    sources,
)

Configure = Callable[..., list[Unit]]

FLAGS = ("-std=c11", "-O2", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Wdouble-promotion", "-Werror")
FOR_A_PC = (
    "firmware/control/*.c",
    "firmware/ecu/*.c",
    "firmware/ports/inproc/*.c",
    "firmware/ports/linux/*.c",
    "tools/latency/*.c",
)
FOR_A_BOARD = ("firmware/control/*.c", "firmware/ecu/*.c", "firmware/ports/cortex_m/**/*.c")
GENERATED = "can_protocol/generated/*.c"
PRESETS = [
    preset["name"]
    for preset in json.loads((ROOT / "CMakePresets.json").read_text("utf-8"))["configurePresets"]
    if "toolchainFile" in preset
]


@dataclass(frozen=True)
class Target:
    """A compiler and what it compiles for; `preset` for those that have one of their own."""

    compiler: str
    extra: tuple[str, ...] = ()
    preset: str = ""


# clang warns before it optimises, gcc while it does; -O1 is enough for that the second time.
TARGETS = {
    "gcc": Target("gcc", ("-g0",)),
    "gcc-m32": Target("gcc", ("-m32", "-g0", "-O1")),
    "clang": Target("clang", ("-fsyntax-only",)),
    "clang-m32": Target("clang", ("-m32", "-fsyntax-only")),
} | {preset: Target("arm-none-eabi-gcc", ("-g0",), preset) for preset in PRESETS}


@pytest.fixture(params=TARGETS)
def target(request: pytest.FixtureRequest) -> Target:
    """Each compiler and word size in turn."""
    chosen = TARGETS[request.param]
    need(chosen.compiler)
    if "-m32" in chosen.extra:
        need_32_bit()
    return chosen


def units_for(target: Target, configure: Configure) -> list[Unit]:
    """What `target` compiles."""
    if target.preset:
        return configure("--preset", target.preset)
    # the frames do not depend on the number type
    return [unit for unit in configure() if unit.scalar == SCALARS[0] or not unit.source.startswith("can_protocol/")]


def compiled(target: Target, units: list[Unit], folder: Path, root: Path = ROOT) -> list[str]:
    """Warnings and errors."""
    compiler = None if target.preset else target.compiler
    return complaints(run_compilers(units, folder, target.extra, compiler=compiler, root=root))


def test_no_compiler_warns(target: Target, configure: Configure, tmp_path: Path) -> None:
    """GIVEN every source and number type WHEN compiled with the project's flags THEN no compiler says a word."""
    assert compiled(target, units_for(target, configure), tmp_path) == []


def test_no_source_is_left_out(target: Target, configure: Configure) -> None:
    """GIVEN the folders of the firmware WHEN configured THEN each file is compiled, for each number type."""
    files = set(sources(*(FOR_A_BOARD if target.preset else FOR_A_PC), GENERATED))
    units = units_for(target, configure)
    if target.preset:
        files.discard("firmware/ecu/store.c")  # an image without a memory for it: DIARC_IMAGE_STORE
    assert {unit.source for unit in units} == files
    if not target.preset:
        pairs = {(unit.source, unit.scalar) for unit in units}
        core = [file for file in files if file.startswith(CORE)]
        assert pairs >= {(file, scalar) for file in core for scalar in SCALARS}


UNROLL = '_Pragma("GCC unroll 9")'  # the one pragma there is: it says nothing about warnings


def test_no_flag_is_lost_or_switched_off(target: Target, configure: Configure) -> None:
    """GIVEN every source WHEN configured THEN all flags are there, and none that takes one back; and no source does."""
    for unit in units_for(target, configure):
        assert set(FLAGS) <= set(unit.flags), unit
        assert [flag for flag in unit.flags if re.match(r"-w$|-Wno-|-O[^23s]?$|-isystem", flag)] == [], unit
    for source in sources("firmware/**/*.[ch]", "can_protocol/generated/*.[ch]"):
        text = (ROOT / source).read_text("utf-8").replace(UNROLL, "")
        assert not re.search(r"#\s*pragma|_Pragma|__extension__", text), source


WARNINGS = {
    "conversion": "uint8_t injected(int32_t x) { return x; }",
    "shadow": "int injected(int x) { if (x > 0) { int x = 1; return x; } return 0; }",
    "double-promotion": "int injected(float x) { return x > 0.5; }",
    "unused-parameter": "int injected(int x) { return 0; }",
    "sign-compare": "int injected(int x, unsigned y) { return x < y; }",
    "maybe-uninitialized": "int injected(int x) { int y; if (x > 2) { y = x; } return x > 1 ? y : 0; }",
}
# right where a long has 64 bits
LONG = "long injected(int64_t x) { return x; }"


def test_injected_warnings_do_not_pass(target: Target, configure: Configure, tmp_path: Path) -> None:
    """GIVEN code with a defect that each flag is for WHEN compiled THEN each is refused, by the flag's name."""
    root = copy_firmware(tmp_path / "copy")
    unit = next(u for u in units_for(target, configure) if u.source == "firmware/ecu/e2e.c")
    clean = (root / unit.source).read_text("utf-8")
    assert compiled(target, [unit], tmp_path, root) == []
    blind = set()
    if target.compiler == "clang":
        blind.add("maybe-uninitialized")  # clang does not look into conditions
    elif "-m32" in target.extra:
        blind.add("double-promotion")  # the PC's old arithmetic unit has but one format
    for flag in WARNINGS.keys() - blind:
        (root / unit.source).write_text(clean, "utf-8")
        append(root, unit.source, WARNINGS[flag])
        said = "".join(compiled(target, [unit], tmp_path, root))
        assert re.search(rf"-W(error=|error,-W)?(implicit-int-)?{flag}\b", said), (flag, said)


def test_word_size_is_not_the_same_for_all(target: Target, configure: Configure, tmp_path: Path) -> None:
    """GIVEN code that is right with 64 bits only WHEN compiled THEN targets of 32 bits refuse it, and no others."""
    root = copy_firmware(tmp_path / "copy")
    unit = next(u for u in units_for(target, configure) if u.source == "firmware/ecu/e2e.c")
    append(root, unit.source, f"{LONG.split('{')[0].strip()}; {LONG}")
    narrow = bool(target.preset) or "-m32" in target.extra
    assert bool(compiled(target, [unit], tmp_path, root)) == narrow
