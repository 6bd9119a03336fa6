"""What the tests of the rules share."""

from __future__ import annotations

import subprocess
from collections.abc import Callable

import pytest

from tests.rules.compilers import LIMIT_S, ROOT, Unit, need, units_in


@pytest.fixture(scope="session")
def configure(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., list[Unit]]:
    """Units of the project configured by CMake with the given options; each configuration is made once."""
    made: dict[tuple[str, ...], list[Unit]] = {}

    def units(*options: str) -> list[Unit]:
        need("cmake")
        if options not in made:
            folder = tmp_path_factory.mktemp("configure")
            command = ["cmake", "-S", str(ROOT), "-B", str(folder), f"-DDIARC_ECU_DIR={folder}", *options]
            result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=LIMIT_S)
            assert result.returncode == 0, result.stdout + result.stderr
            made[options] = units_in(folder)
        return made[options]

    return units
