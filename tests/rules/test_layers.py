"""What the packages of sil_plant must never do: import one above them, or stand outside the layers of pyproject.toml.

Each refusal is tried on a copy with one violation in it.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.rules.compilers import LIMIT_S, ROOT

PACKAGES = sorted(path.parent.name for path in (ROOT / "sil_plant").glob("*/__init__.py"))
LINT = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True))"


def lint(root: Path) -> subprocess.CompletedProcess[str]:
    """import-linter on the sil_plant of a folder, with the folder's pyproject.toml."""
    return subprocess.run(
        [sys.executable, "-c", LINT], cwd=root, capture_output=True, text=True, timeout=LIMIT_S, check=False
    )


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """A folder with the sources of sil_plant and the table of layers."""
    shutil.copytree(
        ROOT / "sil_plant", tmp_path / "sil_plant", ignore=shutil.ignore_patterns("__pycache__", "*.toml", "*.npz")
    )
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def test_no_package_imports_one_above_it() -> None:
    """GIVEN sil_plant WHEN held against the layers THEN every import goes downwards."""
    said = lint(ROOT)
    assert said.returncode == 0, said.stdout + said.stderr


@pytest.mark.parametrize(
    ("source", "line", "named"),
    [
        ("bus/frames.py", "from sil_plant.loop import session", "sil_plant.bus.frames -> sil_plant.loop.session"),
        ("plant/dynamics.py", "from sil_plant.bus import frames", "sil_plant.plant.dynamics -> sil_plant.bus.frames"),
        (
            "inputs/machine.py",
            "def later():\n    from sil_plant.reports.figures import DPI",
            "sil_plant.inputs.machine -> sil_plant.reports.figures",
        ),
        ("config.py", "import sil_plant.inputs.faults", "sil_plant.config -> sil_plant.inputs.faults"),
        ("loop/results.py", "import sil_plant.run", "sil_plant.loop.results -> sil_plant.run"),
    ],
)
def test_an_import_upwards_is_not_let_through(copied: Path, source: str, line: str, named: str) -> None:
    """GIVEN an import of a higher package, of a neighbour, or inside a function WHEN checked
    THEN it is refused and named.
    """
    with (copied / "sil_plant" / source).open("a", encoding="utf-8") as file:
        file.write(f"\n\n{line}\n")
    said = lint(copied)
    assert said.returncode == 1, said.stdout + said.stderr
    assert named in " ".join(said.stdout.split()), said.stdout


def test_a_new_package_does_not_stay_outside_the_layers(copied: Path) -> None:
    """GIVEN a package that the table of layers does not name WHEN checked THEN it is refused and named."""
    (copied / "sil_plant" / "elsewhere").mkdir()
    (copied / "sil_plant" / "elsewhere" / "__init__.py").write_text('"""New."""\n', encoding="utf-8")
    said = lint(copied)
    assert said.returncode == 1, said.stdout + said.stderr
    assert "elsewhere" in said.stdout


def test_the_readme_does_not_leave_a_package_out() -> None:
    """GIVEN the README's table of packages WHEN compared with the folders THEN they are the same."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    table = text.split("| package | content |", 1)[1].split("\n\n", 1)[0]
    assert sorted(re.findall(r"^\| `(\w+)/` \|", table, re.MULTILINE)) == PACKAGES
