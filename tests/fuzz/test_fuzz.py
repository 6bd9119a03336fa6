"""A minute of fuzzing for each harness, from the inputs that are kept: no crash and no invariant broken.

``make fuzz`` runs longer. What reaches more code is kept in ``build/fuzz/found-*``, for ``make fuzz-corpus``; the input
of a crash in ``build/fuzz/crash-*``; the message says how to make a test of it.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.rules.compilers import ROOT, need

HERE = ROOT / "tests" / "fuzz"
BUILD = ROOT / "build" / "fuzz"
SECONDS = int(os.environ.get("FUZZ_SECONDS", "60"))
BUILD_LIMIT_S = 400.0
INPUT_LIMIT_S = 20  # for one input, which takes some milliseconds
KEPT_MAX = 200  # files of a corpus
HARNESSES = sorted(path.stem.removeprefix("fuzz_") for path in HERE.glob("fuzz_*.c"))


def run(command: list[str], limit_s: float) -> subprocess.CompletedProcess[str]:
    """A command's result, its output in one."""
    return subprocess.run(
        command,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=limit_s,
        errors="replace",
    )


@pytest.fixture(scope="module")
def build() -> Path:
    """The harnesses by clang, brought up to date."""
    need("cmake", "clang")
    targets = [f"fuzz_{name}_double" for name in HARNESSES]
    jobs = str(os.cpu_count() or 1)
    for command in (
        ["cmake", "--preset", "fuzz"],
        ["cmake", "--build", str(BUILD), "--parallel", jobs, "--target", *targets],
    ):
        result = run(command, BUILD_LIMIT_S)
        if "libclang_rt.fuzzer" in result.stdout:
            pytest.fail("clang has no libFuzzer: make setup names the package", pytrace=False)
        assert result.returncode == 0, result.stdout[-4000:]
    return BUILD / "tests"


def fuzz(build: Path, name: str) -> list[str]:
    """The command that fuzzes with a harness."""
    found = BUILD / f"found-{name}"
    found.mkdir(exist_ok=True)
    return [
        str(build / f"fuzz_{name}_double"),
        f"-max_total_time={SECONDS}",
        "-max_len=512",
        "-len_control=20",
        f"-timeout={INPUT_LIMIT_S}",
        "-print_final_stats=1",
        f"-artifact_prefix={BUILD}/",
        str(found),
        str(HERE / "corpus" / name),
    ]


@pytest.fixture(scope="module")
def ended(build: Path) -> dict[str, subprocess.CompletedProcess[str]]:
    """How all harnesses ended, which ran side by side."""
    with ThreadPoolExecutor(len(HARNESSES)) as pool:
        return dict(
            zip(HARNESSES, pool.map(lambda name: run(fuzz(build, name), SECONDS + 100), HARNESSES), strict=True)
        )


@pytest.mark.timeout(BUILD_LIMIT_S * 2 + SECONDS + 120)
@pytest.mark.parametrize("name", HARNESSES)
def test_something_on_the_bus_breaks_the_ecu(ended: dict[str, subprocess.CompletedProcess[str]], name: str) -> None:
    """GIVEN the inputs that are kept WHEN libFuzzer goes on from them THEN nothing that must hold is broken."""
    result = ended[name]
    if result.returncode != 0:
        pytest.fail(
            f"{result.stdout[-6000:]}\nKeep the input as a test: mv {BUILD.relative_to(ROOT)}/crash-.. "
            f"tests/fuzz/crashes/{name}/NAME; to look into it: FUZZ_TRACE=1 {result.args[0]} FILE",
            pytrace=False,
        )
    assert "stat::number_of_executed_units:" in result.stdout


@pytest.mark.parametrize("name", HARNESSES)
def test_kept_inputs_are_too_many(name: str) -> None:
    """GIVEN a corpus WHEN counted THEN it is there, and small; make it so again: make fuzz-corpus."""
    files = list((HERE / "corpus" / name).iterdir())
    assert 20 <= len(files) < KEPT_MAX
    assert max(file.stat().st_size for file in files) <= 512


def test_broken_invariant_passes(tmp_path: Path) -> None:
    """GIVEN a harness's source with an invariant that cannot hold WHEN it is run on kept inputs THEN it stops there."""
    need("gcc")
    copy = tmp_path / "fuzz"
    shutil.copytree(HERE, copy, ignore=shutil.ignore_patterns("corpus", "crashes"))
    bench = (copy / "bench.c").read_text("utf-8")
    spoiled = bench.replace("SPOOL_MAX = 16384", "SPOOL_MAX = 16000")
    assert spoiled != bench
    (copy / "bench.c").write_text(spoiled, "utf-8")
    sources = [str(path) for folder in ("control", "ecu") for path in sorted((ROOT / "firmware" / folder).glob("*.c"))]
    sources += [str(path) for path in sorted((ROOT / "can_protocol" / "generated").glob("*.c"))]
    program = tmp_path / "replay"
    flags = ["-std=c11", "-O1", "-DDIARC_SCALAR_DOUBLE=1", f"-I{ROOT / 'firmware'}", f"-I{ROOT}", "-o", str(program)]
    own = [str(copy / name) for name in ("fuzz_frames.c", "bench.c", "replay.c")]
    made = run(["gcc", *flags, *own, *sources, "-lm"], BUILD_LIMIT_S)
    assert made.returncode == 0, made.stdout[-2000:]
    result = run([str(program), str(HERE / "corpus" / "frames")], 100)
    assert result.returncode != 0
    assert "broken: a set-point is beyond the valve's travel" in result.stdout
