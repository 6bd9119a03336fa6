"""Sanitizers: errors of memory and arithmetic that no assertion sees, in every unit test of every number type."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from tests.rules.compilers import ROOT, SCALARS, need, sources

BUILD = ROOT / "build" / "sanitize"
LIMIT_S = 500.0
pytestmark = pytest.mark.timeout(2 * LIMIT_S)  # for the first one, which builds
CONFIGURE = ["cmake", "--preset", "sanitize"]
JOBS = str(os.cpu_count() or 1)


def run(command: list[str], cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """A command's result, its output in one."""
    return subprocess.run(
        command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=LIMIT_S
    )


@pytest.fixture(scope="module")
def build() -> Path:
    """The sanitizers' build, brought up to date."""
    need("cmake", "gcc")
    for command in (CONFIGURE, ["cmake", "--build", str(BUILD), "--parallel", JOBS]):
        result = run(command)
        assert result.returncode == 0, result.stdout[-4000:]
    return BUILD


def test_no_unit_test_breaks_a_rule_of_memory_or_arithmetic(build: Path) -> None:
    """GIVEN every unit test and number type, built with both sanitizers WHEN run THEN all pass and none is left out."""
    result = run(["ctest", "--test-dir", str(build), "--output-on-failure", "--no-tests=error", "--parallel", JOBS])
    assert result.returncode == 0, result.stdout[-8000:]
    ran = set(re.findall(r"(test_\w+) \.+ +Passed", result.stdout))
    for name in (Path(source).stem for source in sources("tests/unit/test_*.c")):
        assert ran & {f"{name}_{scalar}" for scalar in SCALARS}, f"{name} was not run"
    assert {f"test_diarc_{scalar}" for scalar in SCALARS} <= ran


def sanitized_flags(build: Path) -> list[str]:
    """Flags of a unit test for fixed point, as it is compiled there."""
    entries = json.loads((build / "compile_commands.json").read_text("utf-8"))
    command = next(
        e["command"] for e in entries if "/tests/unit/" in e["file"] and "DIARC_SCALAR_FIXED" in e["command"]
    )
    arguments = shlex.split(command)
    return [flag for flag in arguments[1 : arguments.index("-o")] if not flag.startswith("-W")]


def run_program(build: Path, folder: Path, body: str) -> subprocess.CompletedProcess[str]:
    """Compile `body` as a unit test is, against the sanitized libraries, and run it."""
    source = folder / "program.c"
    source.write_text(
        "#include <stdlib.h>\n"
        '#include "control/arm_model.h"\n#include "control/scalar.h"\n#include "control/ud_factors.h"\n'
        "int main(void)\n{\n    volatile int one = 1;\n" + body + "\n    return one - 1;\n}\n",
        "utf-8",
    )
    program = folder / "program"
    libraries = [str(build / f"libdiarc_{name}_fixed.a") for name in ("core", "control")]
    made = run(["gcc", *sanitized_flags(build), str(source), "-o", str(program), *libraries], folder)
    assert made.returncode == 0, made.stdout
    return run([str(program)], folder)


def test_sanitizers_do_not_stop_a_program_without_error(build: Path, tmp_path: Path) -> None:
    """GIVEN a program that breaks no rule WHEN run THEN it ends with 0 and says nothing."""
    result = run_program(build, tmp_path, "    (void)sine(SCALAR(1) * one);")
    assert (result.returncode, result.stdout) == (0, "")


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("    int32_t x = INT32_MAX;\n    one = x + one;", "signed integer overflow"),
        ("    int32_t x = 1 << (31 + one);\n    one = x;", "shift exponent"),
        ("    int a[2] = {0, 0};\n    one = a[one + 1];", "out of bounds|stack-buffer-overflow"),
        ("    char *volatile p = malloc(4);\n    one = p[3 + one];\n    free(p);", "heap-buffer-overflow"),
        ("    char *p = malloc(4);\n    free(p);\n    one = p[0];", "heap-use-after-free"),
        ("    char *volatile p = malloc(4);\n    p = NULL;\n    (void)p;", "detected memory leaks"),
    ],
    ids=["overflow", "shift", "bounds", "heap", "freed", "leak"],
)
def test_error_in_a_test_program_does_not_pass(build: Path, tmp_path: Path, body: str, said: str) -> None:
    """GIVEN a program with an error WHEN run THEN it is stopped, and the error named."""
    result = run_program(build, tmp_path, body)
    assert result.returncode != 0
    assert re.search(said, result.stdout), result.stdout[:2000]


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("    (void)sine(INT32_MAX - one);", "scalar.*signed integer overflow"),
        (
            "    struct arm_row row = {{0}, 0};\n    scalar theta[2] = {0, 0};\n"
            "    (void)arm_row_torque(&row, one == 1 ? SWING : WRIST, theta);",
            "arm_model.*(out of bounds|stack-buffer-overflow)|stack-buffer-overflow.*arm_model",
        ),
        (
            "    struct ud_factors ud = {.size = 9};\n    (void)ud_variance(&ud, (uint8_t)(one + 8));",
            "ud_factors.*out of bounds",
        ),
    ],
    ids=["overflow", "memory", "bounds"],
)
def test_error_inside_the_law_does_not_pass(build: Path, tmp_path: Path, body: str, said: str) -> None:
    """GIVEN a call that leads the law itself into an error WHEN run THEN the law's library stops it, by file."""
    result = run_program(build, tmp_path, body)
    assert result.returncode != 0
    assert re.search(said, result.stdout, re.DOTALL), result.stdout[:2000]
